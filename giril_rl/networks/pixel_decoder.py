"""GIRIL's decoder for pixels, whole and as its two parts, and the layers that make it fast."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from giril_rl.networks.pixels import FEATURES, SIDE, SLOPE, flat_frames, xavier

ROWS = 4
"""Neighbouring rows that are computed at once, as channels."""
_AT_ONCE = 8
"""Encodings decoded at a time without gradient: the intermediate images fit into a CPU's cache."""


class PixelDecoder(nn.Module):
    """Predicts the next frames from an action encoding and the present frames (paper, Table 2).

    encoding -> 64 -> 1024 -> 64x4x4 -> four transposed convolutions 3x3 of stride 2, channels 64,
    64, 32, 32 (4 -> 9 -> 19 -> 39 -> 79) -> one of 6x6 to the frames' channels, 84x84. That image
    and the observation, concatenated, go through one 3x3 convolution of dilation 2 without
    activation. The 6x6 layer is the released code's: the paper's table does not reach 84x84, nor
    four channels.

    As the state enters at the last layer only, ``decoder(encoding, s)`` is ``code_part(encoding)``
    plus a convolution of ``s`` alone. For a one-hot ``a`` the former is ``action_table()[a]``.

    Args:
        actions: number of actions, the size of the encoding.
        channels: frames in an observation.

    Examples:
        >>> PixelDecoder(6)(torch.zeros(2, 6), torch.zeros(2, 4, 84, 84)).shape
        torch.Size([2, 4, 84, 84])
    """

    def __init__(self, actions: int, channels: int = 4) -> None:
        super().__init__()
        self.actions = actions
        self.channels = channels
        layers: list[nn.Module] = []
        for before, after in pairwise((64, 64, 64, 32, 32)):
            layers += [
                TransposedConv(before, after, 3, stride=2),
                nn.LeakyReLU(SLOPE, inplace=True),
            ]
        self.painter = xavier(
            nn.Sequential(
                nn.Linear(actions, 64),
                nn.LeakyReLU(SLOPE),
                nn.Linear(64, FEATURES),
                nn.LeakyReLU(SLOPE),
                ChannelsLast(1, (64, 4, 4)),
                *layers,
                RowsTransposedConv(32, channels, 6),
            )
        )
        self.last = xavier(nn.Conv2d(2 * channels, channels, 3, padding=2, dilation=2))

    @property
    def state_weight(self) -> Tensor:
        """The last convolution's weights for the observation, ``(channels, channels, 3, 3)``."""
        return self.last.weight[:, self.channels :]

    def image(self, encoding: Tensor) -> Tensor:
        """All that happens before the last convolution: ``(*batch, channels, 84, 84)``."""
        flat = encoding.reshape(-1, self.actions)
        if torch.is_grad_enabled() or flat.device.type != "cpu":
            painted = self.painter(flat)
        else:
            painted = torch.cat([self.painter(some) for some in flat.split(_AT_ONCE)])
        return painted.reshape(*encoding.shape[:-1], self.channels, SIDE, SIDE)

    def forward(self, encoding: Tensor, observation: Tensor) -> Tensor:
        """The prediction, scaled but not clamped.

        Args:
            encoding: encoded actions ``(*batch, actions)``.
            observation: scaled to [-1, 1], ``(*batch, channels, 84, 84)``.
        """
        frames = flat_frames(observation, self.channels)
        image = self.image(encoding).reshape(frames.shape)
        joined = torch.cat((image, frames), 1).contiguous(memory_format=torch.channels_last)
        return self.last(joined).reshape(observation.shape)

    def action_table(self) -> Tensor:
        """What each action adds to the prediction, bias included: ``(actions, channels, 84, 84)``.

        Examples:
            >>> PixelDecoder(6).action_table().shape
            torch.Size([6, 4, 84, 84])
        """
        weight = self.last.weight
        return self.code_part(torch.eye(self.actions, dtype=weight.dtype, device=weight.device))

    def code_part(self, encoding: Tensor) -> Tensor:
        """What encodings ``(n, actions)`` add to the prediction, bias included.

        Examples:
            >>> PixelDecoder(6).code_part(torch.rand(2, 6)).shape
            torch.Size([2, 4, 84, 84])
        """
        half = self.last.weight[:, : self.channels]
        return F.conv2d(self.image(encoding), half, self.last.bias, padding=2, dilation=2)


class ChannelsLast(nn.Unflatten):
    """``nn.Unflatten(1, (channels, height, width))`` with channels last in memory.

    The layers that follow keep that layout. A CPU's convolutions are several times as fast in it.

    Examples:
        >>> x = ChannelsLast(1, (2, 3, 3))(torch.zeros(5, 18))
        >>> x.shape, x.is_contiguous(memory_format=torch.channels_last)
        (torch.Size([5, 2, 3, 3]), True)
    """

    def forward(self, input: Tensor) -> Tensor:
        """``(n, channels, height, width)`` for ``(n, channels * height * width)``."""
        return super().forward(input).contiguous(memory_format=torch.channels_last)


class TransposedConv(nn.ConvTranspose2d):
    """``nn.ConvTranspose2d`` that adds its bias separately, in place.

    On a CPU, torch spends more time on a transposed convolution's bias than on the convolution
    (torch 2.13: 40 ms against 10 for 32 of the decoder's largest).

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

    It is a convolution with the flipped kernel, see :func:`rows_kernel`. On other devices, and
    where the output's height is no multiple of four, torch's own computes it.

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
    """Computes rows at once in the forward pass alone: their own gradient would be slow."""

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


def rows_kernel(weight: Tensor, dilation: int = 1) -> Tensor:
    """The kernel that computes four rows at once, an output channel for each.

    Four output channels leave most of a CPU's vector unit idle. Sixteen of them, with a stride of
    four rows and a kernel over all that the four rows read, fill it.

    Args:
        weight: a convolution's, ``(out, channels, height, width)``.
        dilation: between the rows that it reads.

    Returns:
        ``(out * 4, channels, 3 + rows read, width)``, for a stride of four rows and no dilation
        of rows.

    Examples:
        >>> rows_kernel(torch.tensor([[[[1.0], [2.0]]]])).squeeze()
        tensor([[1., 2., 0., 0., 0.],
                [0., 1., 2., 0., 0.],
                [0., 0., 1., 2., 0.],
                [0., 0., 0., 1., 2.]])
    """
    out, channels, height, width = weight.shape
    read = dilation * (height - 1) + 1
    packed = weight.new_zeros(out, ROWS, channels, read + ROWS - 1, width)
    for row in range(ROWS):
        packed[:, row, :, row : row + read : dilation] = weight
    return packed.flatten(0, 1)
