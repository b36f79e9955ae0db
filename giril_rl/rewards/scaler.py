"""Observations brought to the scale on which a reward model measures its error."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor, nn

from giril_rl.errors import UserError
from giril_rl.networks.normalise import check_size
from giril_rl.rewards.transitions import check_finite

ScalingRule = Literal["demo_range", "standardise", "raw"]


class ObservationScaler(nn.Module):
    """An affine map of each observation dimension, fitted once to the demonstration.

    The paper normalises states to [-1, 1] before it compares them (section 5.1); how is left open
    for vectors, so the rule is a choice.

    Args:
        observation_dim: size of the observation's last dimension.
        rule: ``"demo_range"`` maps the demonstration's minimum and maximum of each dimension to -1
            and 1, ``"standardise"`` its mean to 0 and its (population) standard deviation to 1,
            ``"raw"`` neither shifts nor divides and needs no :meth:`fit`. A dimension that is
            constant in the demonstration is only shifted to 0.
        clamp: clamp the result to [-limit, limit], raw observations too: ``rule="raw"`` leaves them
            as they are with ``clamp=False``.
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
        """Computes the map from raw observations ``(*batch, observation_dim)``; returns itself."""
        dim = self.offset.shape[0]
        if observations.ndim < 2 or observations.shape[-1] != dim or observations.numel() == 0:
            raise UserError(
                f"the scaler is fitted to observations of shape (N, {dim}) with N >= 1, not "
                f"{tuple(observations.shape)}."
            )
        data = observations.reshape(-1, dim).to(device=self.offset.device, dtype=torch.float64)
        check_finite("observation", observations)
        if self.rule == "raw":
            return self
        low, high = data.amin(0), data.amax(0)
        if self.rule == "demo_range":
            offset, half_width = (low + high) / 2, (high - low) / 2
        else:
            offset, half_width = data.mean(0), data.std(0, unbiased=False)
        # Below float32's rounding a spread means nothing, and dividing by it would mean harm.
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
