"""The decoder's transposed convolutions, with torch's weights and numbers, as a CPU likes them."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from giril_rl.networks.rows import ROWS, rows_kernel


class ChannelsLast(nn.Unflatten):
    """``nn.Unflatten(1, (channels, height, width))`` with channels last in memory.

    Layers that follow keep that layout, in which a CPU's convolutions are several times as fast.

    Examples:
        >>> x = ChannelsLast(1, (2, 3, 3))(torch.zeros(5, 18))
        >>> x.shape, x.is_contiguous(memory_format=torch.channels_last)
        (torch.Size([5, 2, 3, 3]), True)
    """

    def forward(self, input: Tensor) -> Tensor:
        """``(n, channels, height, width)`` for ``(n, channels * height * width)``."""
        return super().forward(input).contiguous(memory_format=torch.channels_last)


class TransposedConv(nn.ConvTranspose2d):
    """``nn.ConvTranspose2d`` that adds its bias apart, in place.

    Torch adds a transposed convolution's bias in a way that takes a CPU longer than the convolution
    (2.13: 40 ms against 10 for 32 of the decoder's largest).

    Args:
        in_channels: channels of the input.
        out_channels: channels of the output.
        kernel_size: side of the kernel.
        stride: side of an input's cell in the output.

    Examples:
        >>> layer, x = TransposedConv(2, 3, 3, stride=2), torch.rand(1, 2, 4, 4)
        >>> plain = F.conv_transpose2d(x, layer.weight, layer.bias, stride=2)
        >>> torch.allclose(layer(x), plain, atol=1e-6)
        True
    """

    def __init__(
        self, in_channels: int, out_channels: int, kernel_size: int, stride: int = 1
    ) -> None:
        super().__init__(in_channels, out_channels, kernel_size, stride=stride)

    def forward(self, input: Tensor, output_size: list[int] | None = None) -> Tensor:
        """As ``nn.ConvTranspose2d``; ``output_size`` is not supported."""
        assert self.bias is not None and output_size is None
        out = F.conv_transpose2d(input, self.weight, None, self.stride)
        return out.add_(self.bias[:, None, None])


class RowsTransposedConv(TransposedConv):
    """A transposed convolution of stride 1 to a few channels, computed for four rows at once.

    It is a convolution of the flipped kernel, see :func:`~giril_rl.networks.rows.rows_kernel`. On
    other devices, and where the output's height is no multiple of four, it is computed as it is.

    Args:
        in_channels: channels of the input.
        out_channels: channels of the output.
        kernel_size: side of the kernel.

    Examples:
        >>> layer, x = RowsTransposedConv(2, 3, 6), torch.rand(1, 2, 7, 7)
        >>> plain = F.conv_transpose2d(x, layer.weight, layer.bias)
        >>> torch.allclose(layer(x), plain, atol=1e-6)
        True
    """

    def __init__(self, in_channels: int, out_channels: int, kernel_size: int) -> None:
        super().__init__(in_channels, out_channels, kernel_size)

    def forward(self, input: Tensor, output_size: list[int] | None = None) -> Tensor:
        """``(n, out_channels, height + kernel_size - 1, ...)``."""
        assert self.bias is not None
        height = input.shape[-2] + self.kernel_size[0] - 1
        if input.device.type != "cpu" or height % ROWS:
            return super().forward(input, output_size)
        return _ByRows.apply(input, self.weight) + self.bias[:, None, None]


class _ByRows(torch.autograd.Function):
    """The rows are for the forward pass alone: their own gradient would be the slow part."""

    @staticmethod
    def forward(input: Tensor, weight: Tensor) -> Tensor:
        plain, border = weight.transpose(0, 1).flip(2, 3), weight.shape[-1] - 1
        out = F.conv2d(input, rows_kernel(plain), stride=(ROWS, 1), padding=border)
        return out.unflatten(1, (-1, ROWS)).transpose(2, 3).flatten(2, 3)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        input, weight = ctx.saved_tensors
        gradient = gradients[0].contiguous(memory_format=torch.channels_last)
        wanted = [*ctx.needs_input_grad, False]
        one, none, transposed, groups = [1, 1], [0, 0], True, 1
        found = torch.ops.aten.convolution_backward(
            gradient, input, weight, None, one, none, one, transposed, none, groups, wanted
        )
        return found[0], found[1]
