"""Multilayer perceptrons for vector observations: two hidden layers of 100, tanh (section 5.2)."""

from __future__ import annotations

from collections.abc import Sequence

from torch import nn
from torchrl.modules import MLP


def mlp(in_features: int, out_features: int, hidden: Sequence[int] = (100, 100)) -> MLP:
    """TorchRL's ``MLP`` with tanh between its layers and a linear output.

    It concatenates several inputs along their last dimension.

    Args:
        in_features: total size of the inputs' last dimensions.
        out_features: size of the output's last dimension.
        hidden: sizes of the hidden layers; the paper uses two of 100.

    Examples:
        >>> import torch
        >>> mlp(5, 1)(torch.zeros(7, 3), torch.zeros(7, 2)).shape
        torch.Size([7, 1])
    """
    return MLP(in_features, out_features, num_cells=list(hidden), activation_class=nn.Tanh)
