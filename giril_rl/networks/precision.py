"""Matrix products in bfloat16 between the first and the last layer of a perceptron."""

from __future__ import annotations

from typing import Literal, get_args

import torch.nn.functional as F
from torch import Tensor, nn

from giril_rl.errors import UserError

Precision = Literal["fp32", "bf16"]


class BFloat16Linear(nn.Linear):
    """A linear layer whose product is of bfloat16 numbers; parameters and result are its own dtype.

    Products are rounded to bfloat16 once they are summed. Gradients are of the same kind.

    Examples:
        >>> import torch
        >>> layer = BFloat16Linear(64, 32)
        >>> layer(torch.randn(8, 64)).dtype
        torch.float32
    """

    def forward(self, input: Tensor) -> Tensor:
        """The layer's result for ``(*batch, in_features)``."""
        product = F.linear(input.bfloat16(), self.weight.bfloat16()).to(input.dtype)
        return product if self.bias is None else product + self.bias


def in_precision(network: nn.Sequential, precision: Precision) -> nn.Sequential:
    """Puts :class:`BFloat16Linear` between the hidden units of a perceptron, for ``"bf16"``.

    The first and the last layer stay as they are: observations may differ by less than bfloat16
    tells apart, and so may values and actions. Weights stay, too.

    Args:
        network: changed in place.
        precision: "fp32", which changes nothing, or "bf16".

    Raises:
        UserError: for another precision.

    Examples:
        >>> network = nn.Sequential(nn.Linear(2, 8), nn.ReLU(), nn.Linear(8, 8), nn.Linear(8, 1))
        >>> [type(part).__name__ for part in in_precision(network, "bf16")]
        ['Linear', 'ReLU', 'BFloat16Linear', 'Linear']
    """
    if precision not in get_args(Precision):
        raise UserError(f"precision={precision!r} is unknown: choose fp32 or bf16.")
    if precision == "bf16":
        linear = [(n, part) for n, part in enumerate(network) if isinstance(part, nn.Linear)]
        for index, layer in linear[1:-1]:
            sizes, has_bias = (layer.in_features, layer.out_features), layer.bias is not None
            # Without weights of its own, whose making would draw random numbers.
            half = BFloat16Linear(*sizes, bias=has_bias, device="meta")
            half.load_state_dict(layer.state_dict(keep_vars=True), assign=True)
            network[index] = half
    return network
