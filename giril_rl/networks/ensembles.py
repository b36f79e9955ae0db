"""Several networks of one shape, computed at once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn


class EnsembleLinear(nn.Module):
    """``members`` linear layers, each with its own input, by one batched product.

    Initialised as :class:`torch.nn.Linear` is.

    Examples:
        >>> EnsembleLinear(5, 3, 2)(torch.zeros(5, 7, 3)).shape
        torch.Size([5, 7, 2])
    """

    def __init__(self, members: int, in_features: int, out_features: int) -> None:
        super().__init__()
        bound = 1 / math.sqrt(in_features)
        shape = members, in_features, out_features
        self.weight = nn.Parameter(torch.empty(shape).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(members, 1, out_features).uniform_(-bound, bound))

    def forward(self, inputs: Tensor) -> Tensor:
        """``(members, n, in_features)`` to ``(members, n, out_features)``."""
        return torch.baddbmm(self.bias, inputs, self.weight)


class EnsembleMLP(nn.Module):
    """``members`` multilayer perceptrons of the same input (ReLU, linear output).

    Args:
        members: networks.
        in_features: size of the input's last dimension.
        out_features: size of the output's.
        hidden: sizes of the hidden layers.

    Examples:
        >>> EnsembleMLP(5, 3, 2)(torch.zeros(4, 6, 3)).shape
        torch.Size([5, 4, 6, 2])
    """

    def __init__(
        self, members: int, in_features: int, out_features: int, hidden: Sequence[int] = (256, 256)
    ) -> None:
        super().__init__()
        sizes = [in_features, *hidden, out_features]
        self.layers = nn.ModuleList(EnsembleLinear(members, *pair) for pair in pairwise(sizes))
        self.members = members

    def forward(self, inputs: Tensor) -> Tensor:
        """``(*batch, in_features)`` to ``(members, *batch, out_features)``."""
        x = self.separately(inputs.reshape(1, -1, inputs.shape[-1]).expand(self.members, -1, -1))
        return x.reshape(self.members, *inputs.shape[:-1], x.shape[-1])

    def separately(self, inputs: Tensor) -> Tensor:
        """Each member its own input, ``(members, n, in_features)`` to ``(members, n, k)``."""
        for i, layer in enumerate(self.layers):
            inputs = layer(inputs.relu() if i else inputs)
        return inputs
