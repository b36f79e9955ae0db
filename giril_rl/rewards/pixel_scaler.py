"""Frames of bytes brought to [-1, 1], where reward models compare them."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from giril_rl.errors import UserError


class PixelScaler(nn.Module):
    """``x / 127.5 - 1`` of uint8 frames: what :class:`ObservationScaler` is for vectors.

    The paper normalises states to [-1, 1] before it compares them (section 5.1); for bytes there is
    one way to do so, and nothing to fit.

    Args:
        clamp: clamp predictions to [-1, 1] before they are compared; frames are there anyway.

    Examples:
        >>> PixelScaler()(torch.tensor([[[0, 255]]], dtype=torch.uint8))
        tensor([[[-1.,  1.]]])
    """

    event_dims = 3
    """Dimensions of one observation: channels, height, width."""

    def __init__(self, *, clamp: bool = True) -> None:
        super().__init__()
        self.clamp = clamp

    def fit(self, observations: Tensor) -> PixelScaler:
        """Looks whether these are frames; returns itself.

        Raises:
            UserError: for anything but uint8 of at least three dimensions.
        """
        _check_frames(observations)
        return self

    def forward(self, observation: Tensor) -> Tensor:
        """Scales frames ``(*batch, channels, height, width)``; others are refused as by `fit`."""
        _check_frames(observation)
        return observation.to(torch.get_default_dtype()) / 127.5 - 1

    def extra_repr(self) -> str:
        """Shows clamp when printed."""
        return f"clamp={self.clamp}"


def _check_frames(observations: Tensor) -> None:
    if observations.dtype != torch.uint8 or observations.ndim < 3:
        raise UserError(
            f"pixels are uint8 of shape (*batch, channels, height, width), not "
            f"{observations.dtype} of shape {tuple(observations.shape)}."
        )
