"""Matrix products in bfloat16 between the first and the last layer of a perceptron."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import chain, repeat
from typing import Any, Literal

import torch.nn.functional as F
from torch import Tensor, nn

Precision = Literal["fp32", "bf16"]


class BFloat16Linear(nn.Linear):
    """A linear layer whose product is of bfloat16 numbers; parameters and result are float32.

    Products are rounded to bfloat16 once they are summed. Gradients are of the same kind.

    Examples:
        >>> import torch
        >>> layer = BFloat16Linear(64, 32)
        >>> layer(torch.randn(8, 64)).dtype
        torch.float32
    """

    def forward(self, input: Tensor) -> Tensor:
        """The layer's result for ``(*batch, in_features)``."""
        product = F.linear(input.bfloat16(), self.weight.bfloat16()).float()
        return product if self.bias is None else product + self.bias


def layers_of(count: int, precision: Precision) -> Callable[..., nn.Linear]:
    """Makes the linear layers of a perceptron one after the other.

    With ``"bf16"`` those between hidden units are :class:`BFloat16Linear`. The first and the last
    stay in float32: observations may differ by less than bfloat16 tells apart, and so may values
    and actions.

    Args:
        count: how many layers will be made.
        precision: "fp32" or "bf16".

    Examples:
        >>> make = layers_of(3, "bf16")
        >>> [type(make(2, 2)).__name__ for _ in range(3)]
        ['Linear', 'BFloat16Linear', 'Linear']
    """
    between = repeat(BFloat16Linear if precision == "bf16" else nn.Linear, count - 2)
    kinds: Iterator[type[nn.Linear]] = chain([nn.Linear], between, [nn.Linear])

    def make(in_features: int, out_features: int, **settings: Any) -> nn.Linear:
        return next(kinds)(in_features, out_features, **settings)

    return make
