"""Supported action specs, and the affine map between [-1, 1] and an action's bounds.

Policies and reward models see actions in units in which the bounds are -1 and 1.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    Composite,
    MultiCategorical,
    MultiOneHot,
    OneHot,
    TensorSpec,
    Unbounded,
)

from giril_rl.errors import UserError


def single_action_spec(spec: TensorSpec) -> TensorSpec:
    """The spec itself, or the only one in a Composite.

    Args:
        spec: TorchRL's action spec, with or without the environment's batch dimensions.

    Raises:
        UserError: if it is not a Categorical, a OneHot, or a Bounded or Unbounded of real vectors.

    Examples:
        >>> type(single_action_spec(Composite(action=OneHot(3)))).__name__
        'OneHot'
    """
    while isinstance(spec, Composite) and len(spec.keys()) == 1:
        spec = next(iter(spec.values()))
    several = isinstance(spec, (MultiCategorical, MultiOneHot, Binary, Composite))
    if isinstance(spec, (Categorical, OneHot)) and not several:
        return spec
    real = isinstance(spec, (Bounded, Unbounded)) and spec.dtype.is_floating_point
    if several or not real or not spec.shape:
        raise unsupported(spec)
    return spec


def unsupported(spec: TensorSpec) -> UserError:
    """The error for an action spec of another kind or shape."""
    return UserError(
        f"an action spec of the kind {type(spec).__name__} with shape {tuple(spec.shape)} and "
        f"{spec.dtype} is not supported: give a single Categorical, OneHot or one-dimensional "
        "Bounded or Unbounded one of real numbers."
    )


class AffineMap(NamedTuple):
    """Bounds of each action dimension, and the map ``offset + half_range * u`` to them.

    The map takes -1 and 1 to the bounds. A dimension without two finite bounds keeps its unit:
    ``offset`` 0, ``half_range`` 1. All are float64 ``(size,)`` on the CPU; a missing bound is
    infinite.
    """

    low: Tensor
    high: Tensor
    offset: Tensor
    half_range: Tensor


def affine_map(spec: TensorSpec) -> AffineMap:
    """The map of a Bounded or Unbounded action spec.

    Args:
        spec: with or without the environment's batch dimensions.

    Raises:
        UserError: if the bounds differ between environments.

    Examples:
        >>> affine_map(Bounded(1000.0, 2000.0, shape=(1,))).half_range
        tensor([500.], dtype=torch.float64)
    """
    size = spec.shape[-1]
    low, high = (
        bound.reshape(-1, size).to(device="cpu", dtype=torch.float64)
        for bound in (spec.space.low, spec.space.high)
    )
    if (low != low[0]).any() or (high != high[0]).any():
        raise UserError("the action bounds differ between environments: give them equal ones.")
    # TorchRL writes "no bound" as the largest number of the dtype.
    limit = torch.finfo(spec.dtype).max
    low = torch.where(low[0] <= -limit, -torch.inf, low[0])
    high = torch.where(high[0] >= limit, torch.inf, high[0])
    bounded = low.isfinite() & high.isfinite() & (high > low)
    offset = torch.where(bounded, (low + high) / 2, 0.0)
    half_range = torch.where(bounded, (high - low) / 2, 1.0)
    return AffineMap(low, high, offset, half_range)


class ActionBounds(nn.Module):
    """Maps a policy's draw to an action within the bounds.

    A draw ``u`` becomes ``offset + half_range * u``, clamped to the bounds: -1 and 1 become the
    bounds themselves. A dimension without two finite bounds keeps its unit and is clamped to the
    bound that it has, if any. The buffers follow from the spec and are not saved.

    Args:
        affine: the map of a spec, see :func:`affine_map`.

    Examples:
        >>> bounds = ActionBounds(affine_map(Bounded(1000.0, 2000.0, shape=(1,))))
        >>> bounds(torch.tensor([[0.0], [0.5], [2.0]])).flatten().tolist()
        [1500.0, 1750.0, 2000.0]
        >>> bounds.inverse(torch.tensor([1750.0])).tolist()
        [0.5]
    """

    low: Tensor
    high: Tensor
    offset: Tensor
    half_range: Tensor

    def __init__(self, affine: AffineMap) -> None:
        super().__init__()
        for name, value in affine._asdict().items():
            self.register_buffer(name, value.to(torch.get_default_dtype()), persistent=False)
        self.scales = bool((affine.offset != 0).any() or (affine.half_range != 1).any())
        """Whether any unit differs from the environment's."""

    @classmethod
    def of(cls, spec: TensorSpec) -> ActionBounds | None:
        """The bounds of an action spec; None if it has none, or actions are discrete."""
        spec = single_action_spec(spec)
        if isinstance(spec, (Categorical, OneHot)):
            return None
        affine = affine_map(spec)
        bounded = affine.low.isfinite().any() or affine.high.isfinite().any()
        return cls(affine) if bounded else None

    def forward(self, draw: Tensor) -> Tensor:
        """The action ``(*batch, size)`` in the environment's units, within the bounds."""
        return torch.clamp(torch.addcmul(self.offset, self.half_range, draw), self.low, self.high)

    def inverse(self, action: Tensor) -> Tensor:
        """The draw that gives an action ``(*batch, size)``; one beyond the bounds is kept so."""
        return (action - self.offset) / self.half_range

    def extra_repr(self) -> str:
        """Shows the bounds when printed."""
        return f"low={self.low.tolist()}, high={self.high.tolist()}"
