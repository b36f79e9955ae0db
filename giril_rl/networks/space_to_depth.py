"""The first convolution on frames, computed in blocks."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from giril_rl.errors import UserError

_WORDS = {2: torch.int16, 4: torch.int32, 8: torch.int64}
"""The integer as wide as a block's row of bytes."""


class SpaceToDepthConv(nn.Conv2d):
    """A convolution of bytes, scaled by ``1 / 255``, whose kernel is a multiple of its stride.

    ``Conv2d(4, 32, 8, stride=4)`` of four frames leaves most of a CPU's vector unit idle. Cut into
    blocks of the stride by :func:`deal`, the frames have 64 channels, and the same sum is a 2x2
    convolution of stride 1. Weights keep ``Conv2d``'s shape and names, and results equal
    ``conv(frames / 255)`` up to rounding. PPO's update of the whole network takes 0.6 of the time
    (``tests/benchmarks/atari_training.py`` measures it).

    Args:
        in_channels: frames in an observation.
        out_channels: channels of the output.
        kernel_size: side of the kernel, a multiple of ``stride``.
        stride: stride, which divides the frame's sides.

    Raises:
        UserError: for a kernel that is no multiple of the stride.

    Examples:
        >>> frames = torch.randint(0, 256, (2, 4, 84, 84), dtype=torch.uint8)
        >>> conv = SpaceToDepthConv(4, 32, 8, stride=4)
        >>> plain = F.conv2d(frames / 255, conv.weight, conv.bias, stride=4)
        >>> torch.allclose(conv(deal(frames, 4)), plain, atol=1e-5)
        True
    """

    def __init__(
        self, in_channels: int, out_channels: int, kernel_size: int, *, stride: int
    ) -> None:
        super().__init__(in_channels, out_channels, kernel_size, stride=stride)
        if kernel_size % stride:
            raise UserError(
                f"a kernel of {kernel_size} is no multiple of the stride {stride}: use Conv2d."
            )
        self.block = stride

    def forward(self, dealt: Tensor) -> Tensor:
        """``(N, out_channels, ...)`` for frames that :func:`deal` cut into blocks of the stride."""
        out, side = self.out_channels, self.weight.shape[-1]
        blocks = side // self.block
        weight = (self.weight / 255).unflatten(3, (blocks, -1)).unflatten(2, (blocks, -1))
        weight = weight.permute(0, 1, 3, 5, 2, 4).reshape(out, -1, blocks, blocks)
        return F.conv2d(dealt.to(weight.dtype).permute(0, 3, 1, 2), weight, self.bias)


def deal(frames: Tensor, block: int) -> Tensor:
    """Bytes ``(N, c, h, w)`` as ``(N, h / block, w / block, c * block * block)``.

    The result is channels-last in memory, as the convolution prefers. Moving a block's row as one
    word, and bytes rather than floats, saves three quarters of the work each.

    Examples:
        >>> deal(torch.zeros(2, 4, 84, 84, dtype=torch.uint8), 4).shape
        torch.Size([2, 21, 21, 64])
    """
    if block not in _WORDS:
        rows = frames.unflatten(3, (-1, block)).unflatten(2, (-1, block))
        return rows.permute(0, 2, 4, 1, 3, 5).flatten(3)
    words = frames.contiguous().view(_WORDS[block])
    moved = words.unflatten(2, (-1, block)).permute(0, 2, 4, 1, 3).contiguous()
    return moved.view(frames.dtype).flatten(3)
