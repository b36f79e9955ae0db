"""The demonstration as points, to which a reward measures distances."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase

from giril_rl.errors import UserError
from giril_rl.networks.normalise import check_size
from giril_rl.rewards.actions import ActionEncoder
from giril_rl.rewards.scaler import check_finite
from giril_rl.rewards.transitions import check_actions

SPREAD = 1e-3
"""Added to standard deviations, so that a dimension that hardly moves is not blown up."""
CONSTANT = 1e-6
"""The standard deviation below which a dimension counts as constant and keeps its unit."""


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


def check_vectors(what: str, observation: str) -> None:
    """Refuses a task that does not show vectors.

    Args:
        what: the method's name.
        observation: what the task shows, "vector" or "image".

    Examples:
        >>> check_vectors("PWIL", "image")
        Traceback (most recent call last):
        giril_rl.errors.UserError: PWIL measures distances of vectors and this task shows images:
        choose a task of vectors, or another method.
    """
    if observation != "vector":
        raise UserError(
            f"{what} measures distances of vectors and this task shows images: choose a task of "
            "vectors, or another method."
        )


def spaces_of(what: str, env: EnvBase, use_actions: bool) -> tuple[int, TensorSpec | None]:
    """Size of an environment's observations, and its action spec, None without ``use_actions``.

    Raises:
        UserError: if the environment shows images; ``what`` names the method.
    """
    observation = env.observation_spec["observation"]
    check_vectors(what, "image" if observation.dtype == torch.uint8 else "vector")
    return observation.shape[-1], env.action_spec if use_actions else None
