"""GIRIL's decoder for pixels, whole and as the two parts that it is the sum of."""

from __future__ import annotations

from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from giril_rl.networks.pixels import FEATURES, SIDE, SLOPE, flat_frames, xavier
from giril_rl.networks.upsampling import ChannelsLast, RowsTransposedConv, TransposedConv

_AT_ONCE = 8
"""Codes at a time without gradient: few enough for what is in between to stay in a CPU's cache."""


class PixelDecoder(nn.Module):
    """Predicts the next frames from an action code and the present ones (paper, Table 2).

    code -> 64 -> 1024 -> 64x4x4 -> four transposed convolutions 3x3 of stride 2, channels 64, 64,
    32, 32 (4 -> 9 -> 19 -> 39 -> 79) -> one of 6x6 to the frames' channels, 84x84; that image and
    the observation, joined, go through one 3x3 convolution of dilation 2 without activation. The
    6x6 layer is the released code's: the paper's table does not reach 84x84, nor four channels.

    As the state enters at the last layer only, ``decoder(code, s)`` is ``code_part(code) +
    state_part(s)``, and that of a one-hot ``a`` is ``action_table()[a] + state_part(s)``.

    Args:
        actions: number of actions, the size of the code.
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

    def image(self, code: Tensor) -> Tensor:
        """All that happens before the last convolution: ``(*batch, channels, 84, 84)``."""
        codes = code.reshape(-1, self.actions)
        if torch.is_grad_enabled() or codes.device.type != "cpu":
            painted = self.painter(codes)
        else:
            painted = torch.cat([self.painter(some) for some in codes.split(_AT_ONCE)])
        return painted.reshape(*code.shape[:-1], self.channels, SIDE, SIDE)

    def forward(self, code: Tensor, observation: Tensor) -> Tensor:
        """The prediction, not clamped, for codes ``(*batch, actions)`` and observations.

        Observations ``(*batch, channels, 84, 84)`` are scaled to [-1, 1], and so is the prediction.
        """
        frames = flat_frames(observation, self.channels)
        image = self.image(code).reshape(frames.shape)
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

    def code_part(self, code: Tensor) -> Tensor:
        """What codes ``(n, actions)`` add to the prediction, bias included: ``(n, channels, ...)``.

        Examples:
            >>> PixelDecoder(6).code_part(torch.rand(2, 6)).shape
            torch.Size([2, 4, 84, 84])
        """
        half = self.last.weight[:, : self.channels]
        return F.conv2d(self.image(code), half, self.last.bias, padding=2, dilation=2)

    def state_part(self, observation: Tensor) -> Tensor:
        """What observations ``(*batch, channels, 84, 84)`` add to the prediction, same shape."""
        frames = flat_frames(observation, self.channels)
        return F.conv2d(frames, self.state_weight, padding=2, dilation=2).reshape(observation.shape)
