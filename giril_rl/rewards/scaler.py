"""Scalers: observations on the scale on which a reward model compares them."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor, nn

from giril_rl.errors import UserError
from giril_rl.networks.normalise import check_size

ScalingRule = Literal["demo_range", "standardise", "raw"]


class ObservationScaler(nn.Module):
    """An affine map of each observation dimension, fitted once to the demonstration.

    The paper normalises states to [-1, 1] before it compares them (section 5.1). It does not say
    how vectors are normalised, so the rule is a choice.

    Args:
        observation_dim: size of the observation's last dimension.
        rule: ``"demo_range"`` is min-max scaling: it maps the demonstration's minimum and maximum
            of each dimension to -1 and 1. ``"standardise"`` maps the mean to 0 and the (population)
            standard deviation to 1. ``"raw"`` changes nothing and needs no :meth:`fit`. A dimension
            that is constant in the demonstration is only shifted to 0.
        clamp: clamp the result to [-limit, limit], also that of ``"raw"``.
        limit: the bound.

    Raises:
        UserError: for an unknown rule, for a demonstration that cannot be fitted, for observations
            of another size, or when used before :meth:`fit`.

    Examples:
        >>> scaler = ObservationScaler(2, rule="demo_range")
        >>> _ = scaler.fit(torch.tensor([[0.0, 5.0], [4.0, 5.0]]))
        >>> scaler(torch.tensor([3.0, 6.0])).tolist()
        [0.5, 1.0]
    """

    event_dims = 1
    """Dimensions of one observation."""

    offset: Tensor
    scale: Tensor
    fitted: Tensor

    def __init__(
        self,
        observation_dim: int,
        *,
        rule: ScalingRule = "standardise",
        clamp: bool = True,
        limit: float = 1.0,
    ) -> None:
        super().__init__()
        if rule not in get_args(ScalingRule):
            raise UserError(
                f"normalise={rule!r} is unknown: choose one of {', '.join(get_args(ScalingRule))}."
            )
        self.rule: ScalingRule = rule
        self.clamp = clamp
        self.limit = limit
        self.register_buffer("offset", torch.zeros(observation_dim))
        self.register_buffer("scale", torch.ones(observation_dim))
        self.register_buffer("fitted", torch.tensor(rule == "raw"))
        # Reading a buffer's value waits for the device, so it is read only until it is true.
        self._known_fitted = rule == "raw"

    @torch.no_grad()
    def fit(self, observations: Tensor) -> ObservationScaler:
        """Fits the map to raw observations ``(*batch, observation_dim)``; returns itself."""
        dim = self.offset.shape[0]
        if observations.ndim < 2 or observations.shape[-1] != dim or observations.numel() == 0:
            raise UserError(
                f"the scaler is fitted to observations of shape (N, {dim}) with N >= 1, not "
                f"{tuple(observations.shape)}."
            )
        check_finite("observation", observations)
        if self.rule == "raw":
            return self
        data = observations.reshape(-1, dim).to(device=self.offset.device, dtype=torch.float64)
        low, high = data.amin(0), data.amax(0)
        if self.rule == "demo_range":
            offset, half_width = (low + high) / 2, (high - low) / 2
        else:
            offset, half_width = data.mean(0), data.std(0, unbiased=False)
        # A spread below float32's rounding is noise; dividing by it would blow it up.
        constant = high - low <= 1e-6 * torch.maximum(low.abs(), high.abs())
        half_width = torch.where(constant, 1.0, half_width)
        self.offset.copy_(offset)
        self.scale.copy_(half_width.reciprocal())
        self.fitted.fill_(True)
        self._known_fitted = True
        return self

    def forward(self, observation: Tensor) -> Tensor:
        """Scales observations ``(*batch, observation_dim)`` of any real dtype."""
        check_size(observation, self.offset)
        if not self._known_fitted:
            if not bool(self.fitted):
                raise UserError(
                    "the reward's observation scaler has not seen a demonstration: call "
                    "reward.scaler.fit(observations) first."
                )
            self._known_fitted = True
        scaled = observation.to(self.offset.dtype)
        if self.rule != "raw":
            scaled = (scaled - self.offset) * self.scale
        return scaled.clamp(-self.limit, self.limit) if self.clamp else scaled

    def extra_repr(self) -> str:
        """Shows rule and clamp when printed."""
        return f"{self.offset.shape[0]}, rule={self.rule!r}, clamp={self.clamp}"


class PixelScaler(nn.Module):
    """``x / 127.5 - 1`` of uint8 frames, which brings them to [-1, 1]; there is nothing to fit.

    Args:
        clamp: clamp predictions to [-1, 1] before they are compared. Frames are within it anyway.

    Raises:
        UserError: for anything but uint8 of at least three dimensions.

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
        """Checks that these are frames; returns itself."""
        if observations.dtype != torch.uint8 or observations.ndim < 3:
            raise UserError(
                f"pixels are uint8 of shape (*batch, channels, height, width), not "
                f"{observations.dtype} of shape {tuple(observations.shape)}."
            )
        return self

    def forward(self, observation: Tensor) -> Tensor:
        """Scales frames ``(*batch, channels, height, width)``."""
        self.fit(observation)
        return observation.to(torch.get_default_dtype()) / 127.5 - 1

    def extra_repr(self) -> str:
        """Shows clamp when printed."""
        return f"clamp={self.clamp}"


def check_finite(what: str, values: Tensor) -> None:
    """Refuses NaN and infinity, and names the first. It reads values, so call it once.

    Args:
        what: what the values are, for the message.
        values: of any shape and dtype.

    Raises:
        UserError: if one is not finite.

    Examples:
        >>> check_finite("observation", torch.tensor([[0.0, 1.0], [2.0, float("nan")]]))
        Traceback (most recent call last):
        giril_rl.errors.UserError: the demonstration's observation is nan at index [1, 1]: leave
        that transition out, or correct it.
    """
    if not values.is_floating_point():
        return
    finite = values.isfinite()
    if not finite.all():
        index = (~finite).nonzero()[0].tolist()
        raise UserError(
            f"the demonstration's {what} is {values[tuple(index)].item()} at index {index}: leave "
            "that transition out, or correct it."
        )
