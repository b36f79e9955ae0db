"""Transitions as points: distances between them, and the demonstration as points of an episode.

A demonstrated transition as a point is called an atom, as in optimal transport. There are two
scales, for the methods' sources differ:

- :class:`Atoms`, of rewards of whole episodes (PWIL, Sinkhorn): float64 vectors, every dimension of
  observation and encoded action by itself, standardised as PWIL's authors do it.
- :class:`~giril_rl.rewards.point_reward.PointReward`, of single transitions (nearest neighbour,
  GMMIL): the settings' scaler and bound, frames and the next state as well, and all over the square
  root of the number of dimensions, so that a distance means the same on every task.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torchrl.data import TensorSpec

from giril_rl.errors import UserError
from giril_rl.networks.normalise import check_size
from giril_rl.rewards.actions import ActionEncoder
from giril_rl.rewards.scaler import check_finite
from giril_rl.rewards.transitions import check_actions

DISTANCES_AT_ONCE = 1_000_000
"""Distances held in memory at a time, 4 MB of them."""
EXACT = "donot_use_mm_for_euclid_dist"
"""A mode of torch.cdist: with matrix products, equal points would not be at distance 0."""
MOST_PAIRED = 1_000
"""Points of which a median of pairwise distances is taken; of more, evenly spaced ones."""
SPREAD = 1e-3
"""Added to an atom's standard deviations, so that a dimension that hardly moves is not blown up."""
CONSTANT = 1e-6
"""The standard deviation below which a dimension counts as constant and keeps its unit."""


def in_parts(function: Callable[[Tensor], Tensor], points: Tensor, others: int) -> Tensor:
    """``function(points)`` for a few rows at a time, where each row has ``others`` distances.

    Examples:
        >>> in_parts(lambda x: x.sum(-1), torch.ones(2, 3, 4), others=10).shape
        torch.Size([2, 3])
    """
    flat = points.reshape(-1, points.shape[-1])
    rows = max(1, DISTANCES_AT_ONCE // max(1, others))
    out = [function(part) for part in flat.split(rows)]
    return torch.cat(out).reshape(points.shape[:-1])


def median_distance(points: Tensor, others: Tensor | None = None) -> Tensor:
    """Median Euclidean distance between two sets, or between the pairs of one (median heuristic).

    The lower of the two middle ones of an even number. Of more than :data:`MOST_PAIRED` points it
    takes evenly spaced ones. 1 where there is no pair, or where more than half of the pairs are
    equal, of which no scale can be made.

    Args:
        points: ``(n, d)``.
        others: ``(m, d)``; None takes the pairs of ``points``, none with itself.

    Examples:
        >>> median_distance(torch.tensor([[0.0], [1.0], [4.0]]))  # of 1, 4 and 3
        tensor(3.)
        >>> median_distance(torch.tensor([[0.0]]), torch.tensor([[1.0], [4.0], [6.0]]))
        tensor(4.)
    """
    if others is None:
        distances = nn.functional.pdist(_spaced(points))
    else:
        distances = torch.cdist(_spaced(points), _spaced(others), compute_mode=EXACT).flatten()
    if not len(distances):
        return points.new_ones(())
    median = distances.median()
    return torch.where(median > 0, median, torch.ones_like(median))


def _spaced(points: Tensor) -> Tensor:
    return points[:: max(1, -(-len(points) // MOST_PAIRED))]


class Atoms(nn.Module):
    """The demonstration as points: observation and action as one vector, standardised.

    Each dimension is less its mean in the demonstration, divided by its standard deviation plus
    1e-3, or by 1 where it is constant. Actions are encoded first, see
    :class:`~giril_rl.rewards.ActionEncoder`.

    Args:
        number: how many points.
        observation_dim: size of an observation.
        action_spec: the environment's action spec; None leaves actions out.

    Raises:
        UserError: when used before :meth:`fit`, or for entries of another shape.

    Examples:
        >>> atoms = Atoms(2, observation_dim=1, action_spec=None)
        >>> atoms.fit(torch.tensor([[0.0], [3.998]])).points  # A standard deviation of 1.999.
        tensor([[-0.9995],
                [ 0.9995]], dtype=torch.float64)
    """

    points: Tensor
    squares: Tensor
    offset: Tensor
    scale: Tensor
    fitted: Tensor

    def __init__(self, number: int, observation_dim: int, action_spec: TensorSpec | None) -> None:
        super().__init__()
        self.actions = None if action_spec is None else ActionEncoder(action_spec)
        size = observation_dim + (0 if self.actions is None else self.actions.size)
        # float64, for the nearest of many points is found by a difference of large numbers.
        self.register_buffer("points", torch.zeros(number, size, dtype=torch.float64))
        self.register_buffer("squares", torch.zeros(number, dtype=torch.float64))
        self.register_buffer("offset", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("scale", torch.ones(size, dtype=torch.float64))
        self.register_buffer("fitted", torch.tensor(False))
        self.observation_dim = observation_dim
        self._known_fitted = False

    @torch.no_grad()
    def fit(self, observation: Tensor, action: Tensor | None = None) -> Atoms:
        """Takes the demonstration's observations ``(n, d)`` and actions; returns itself."""
        check_finite("observation", observation)
        if action is not None:
            check_finite("action", action)
        vectors = self._concatenated(observation, action)
        if vectors.shape != self.points.shape:
            raise UserError(
                f"the reward was made for a demonstration of {len(self.points)} transitions, not "
                f"for {tuple(vectors.shape[:-1])}: give as many."
            )
        spread = vectors.std(0, correction=0)
        self.scale.copy_(torch.where(spread < CONSTANT, 1.0, spread + SPREAD).reciprocal())
        self.offset.copy_(vectors.mean(0))
        self.points.copy_((vectors - self.offset) * self.scale)
        self.squares.copy_(self.points.square().sum(1))
        self.fitted.fill_(True)
        return self

    def forward(self, observation: Tensor, action: Tensor | None = None) -> Tensor:
        """Observations ``(*batch, d)`` and actions as float64 vectors ``(*batch, size)``."""
        if not self._known_fitted:
            if not bool(self.fitted):
                raise UserError(
                    "the reward has not seen a demonstration: call reward.fit(transitions) first."
                )
            self._known_fitted = True
        return (self._concatenated(observation, action) - self.offset) * self.scale

    def _concatenated(self, observation: Tensor, action: Tensor | None) -> Tensor:
        check_size(observation, self.scale[: self.observation_dim])
        if self.actions is None:
            return observation.double()
        if action is None:
            raise UserError(
                "the reward compares actions and the demonstration has none: set "
                "reward.use_actions=false."
            )
        check_actions(self.actions, action, observation, 1)
        return torch.cat([observation.double(), self.actions(action).double()], -1)
