"""PWIL: a reward for visiting what the demonstration visited, as often as it did.

``r = alpha * exp(-beta * T / sqrt(d) * c)`` (Dadashi et al., ICLR 2021): the cost c of a step is
what it costs to move the step's weight 1/T to the nearest demonstrated pairs that have weight left.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase

from giril_rl.config.schema import USE_ACTIONS, knob
from giril_rl.errors import UserError
from giril_rl.rewards.method import GREEN, Method, register
from giril_rl.rewards.points import Atoms
from giril_rl.rewards.trajectory import (
    TrajectoryReward,
    check_vectors,
    spaces_of,
    steps_before,
)
from giril_rl.rewards.transitions import REWARD_KEYS
from giril_rl.runs.pretrained import remembered

AT_ONCE = 2**22
"""Distances that are computed at a time, to bound the memory."""


@dataclass
class PWILConfig:
    """PWIL's reward."""

    alpha: float = knob(5.0, "largest reward of a step", low=0, low_open=True)
    beta: float = knob(5.0, "how fast the reward falls with the cost", low=0, low_open=True)
    horizon: int | None = knob(
        None, "steps of an episode that are paid for, T; null takes the task's time limit", low=1
    )
    use_actions: bool = knob(True, USE_ACTIONS)

    def check(self, prefix: str, run: Any) -> None:
        """Refuses frames, before anything is trained."""
        check_vectors("PWIL", run.task.family.observation)


def weights(atoms: int, horizon: int) -> tuple[int, int]:
    """The weights 1/atoms and 1/horizon in the largest unit of which both are multiples.

    Whole numbers add up exactly: the demonstration is used up by T steps, not one earlier or later.

    Args:
        atoms: number of demonstrated atoms.
        horizon: number of steps T.

    Examples:
        >>> weights(4, 6)  # 1/4 is 3/12, 1/6 is 2/12
        (3, 2)
    """
    common = math.gcd(atoms, horizon)
    return horizon // common, atoms // common


def greedy_coupling(
    distance: Tensor, left: Tensor, demand: Tensor, ends: Tensor, full: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Fills each step's weight from the nearest atoms that have any left (PWIL's algorithm 1).

    Weights are whole numbers, see :func:`weights`.

    Args:
        distance: ``(T, N, n)``, from step t of environment i to each of n atoms; only the order
            matters.
        left: int64 ``(N, n)``, each atom's weight that is left.
        demand: int64 ``(T, N)``, each step's weight, at most what is left then.
        ends: bool ``(T, N)``, after which steps all atoms are given back.
        full: an atom's whole weight.

    Returns:
        The moves in order: their steps ``(m,)``, and of each environment the atom and the weight
        that is taken from it, int64 ``(m, N)``, 0 where another environment still needs some. And
        what is left at the end.

    Examples:
        One environment takes two steps near the second of two atoms. Each step has an atom's
        weight, so that the second step has to go to the first atom:

        >>> distance = torch.tensor([[[9.0, 1.0]], [[8.0, 0.5]]])
        >>> left, one = torch.ones(1, 2, dtype=torch.int64), torch.ones(2, 1, dtype=torch.int64)
        >>> step, atom, taken, left = greedy_coupling(distance, left, one, one < 1, full=1)
        >>> step.tolist(), atom.tolist(), taken.tolist(), left.tolist()
        ([0, 1], [[1], [0]], [[1], [1]], [[0, 0]])
    """
    left, atoms = left.clone(), left.shape[1]
    least = -(-int(demand.max()) // full)  # Atoms that a step needs at least.
    whole = full == 1  # Every move takes a whole atom, which needs less bookkeeping.
    nothing, never = distance.new_zeros(()), distance.new_tensor(torch.inf)
    used = torch.where(left == 0, never, nothing)
    asked = demand.unsqueeze(-1)
    emptied, one = torch.where(asked > 0, never, nothing), (asked > 0).long()
    steps: list[int] = []
    moves: list[Tensor] = []
    for t, restart in enumerate(ends.any(1).tolist()):
        near, missing = distance[t] + used, asked[t]
        for count in range(1, atoms + 1):
            nearest = near.min(1, keepdim=True).indices
            if whole:
                taken = one[t]
                used.scatter_add_(1, nearest, emptied[t])
            else:
                there = left.gather(1, nearest)
                taken = torch.minimum(there, missing)
                left.scatter_add_(1, nearest, -taken)
                used.scatter_(1, nearest, torch.where(taken == there, never, nothing))
                missing = missing - taken
            steps.append(t)
            moves += nearest, taken
            if count >= least and (whole or not missing.any()):
                break
            near.scatter_(1, nearest, torch.inf)
        if restart:
            left[ends[t]], used[ends[t]] = full, 0.0
    done = torch.cat(moves, 1).T
    left = (used == 0).long() if whole else left
    return torch.tensor(steps, device=left.device), done[::2], done[1::2], left


def pwil_value(cost: Tensor, *, alpha: float, beta: float, horizon: int, size: int) -> Tensor:
    """``alpha * exp(-beta * T / sqrt(d) * c)`` (Dadashi et al., eq. 6).

    Args:
        cost: c, each step's transport cost, of any shape.
        alpha: the reward of a step without cost.
        beta: sharpness.
        horizon: T, steps of an episode.
        size: d, numbers in an atom.

    Examples:
        >>> pwil_value(torch.tensor([0.0, 0.002]), alpha=5, beta=5, horizon=100, size=4)
        tensor([5.0000, 3.0327])
    """
    return alpha * (-beta * horizon / math.sqrt(size) * cost).exp()


class PWILReward(TrajectoryReward):
    """PWIL's reward, in [0, alpha], of an episode's state-action pairs in order of time.

    Each of the demonstration's n atoms has weight 1/n at an episode's beginning, and each step
    weight 1/T. After T steps the demonstration is used up and the reward is 0.

    Give it the demonstration by :meth:`fit`.

    Args:
        observation_dim: size of the observation.
        action_spec: the environment's action spec; None compares states alone.
        atoms: n, the number of the demonstration's transitions.
        horizon: T, steps of an episode.
        alpha: the largest reward.
        beta: how fast it falls with the cost.
        in_keys: see :class:`~giril_rl.rewards.trajectory.TrajectoryReward`.
        out_keys: where the reward is written, one key.

    Raises:
        UserError: see there.

    Examples:
        An episode that repeats the demonstration gets alpha at every step:

        >>> from tensordict import TensorDict
        >>> s = torch.arange(4.0).unsqueeze(-1)
        >>> reward = PWILReward(1, None, atoms=3, horizon=3)
        >>> _ = reward.fit(TensorDict({"observation": s[:3]}, [3]))
        >>> done = torch.tensor([[False], [False], [True]])
        >>> episode = {"observation": s[:3], "next": {"observation": s[1:], "done": done}}
        >>> batch = TensorDict(episode, [3]).unsqueeze(0)
        >>> reward(batch)["next", "intrinsic_reward"].flatten()
        tensor([5., 5., 5.])
    """

    episode_state: ClassVar[tuple[str, ...]] = (*TrajectoryReward.episode_state, "left")

    left: Tensor

    @remembered
    def __init__(
        self,
        observation_dim: int,
        action_spec: TensorSpec | None,
        *,
        atoms: int,
        horizon: int,
        alpha: float = 5.0,
        beta: float = 5.0,
        in_keys: Sequence[NestedKey] | None = None,
        out_keys: Sequence[NestedKey] = REWARD_KEYS,
    ) -> None:
        demonstration = Atoms(atoms, observation_dim, action_spec)
        super().__init__("a PWIL reward", demonstration, in_keys, out_keys)
        self.horizon, self.alpha, self.beta = horizon, alpha, beta
        self.full, self.each = weights(atoms, horizon)
        self.register_buffer("left", torch.zeros(0, atoms, dtype=torch.int64))

    def begin(self, environments: int) -> None:
        """Gives every environment the whole demonstration."""
        self.left = self.left.new_full((environments, self.left.shape[1]), self.full)

    def restart(self, where: Tensor) -> None:
        """Gives the whole demonstration back where ``where`` is true."""
        self.left = torch.where(where.unsqueeze(-1), self.full, self.left)

    def pay(self, vectors: Tensor, ends: Tensor) -> Tensor:
        """The rewards of the next steps, see the class."""
        size = max(1, AT_ONCE // (len(vectors) * len(self.atoms.points)))
        parts = zip(vectors.split(size, 1), ends.split(size, 1), strict=True)
        return torch.cat([self._pay(*part) for part in parts], 1)

    def _pay(self, vectors: Tensor, ends: Tensor) -> Tensor:
        x, over = vectors.transpose(0, 1), ends.T  # Time first.
        points = self.atoms.points
        # The squared distance less |x|^2, which is the same for all atoms.
        near = torch.addmm(self.atoms.squares, x.flatten(0, 1), points.T, alpha=-2)
        before = (self.full * len(points) - self.left.sum(1)) // self.each
        played = steps_before(ends, before).T
        paid = played < self.horizon
        step, atom, taken, self.left = greedy_coupling(
            near.view(*x.shape[:2], -1), self.left, paid * self.each, over, self.full
        )
        moved = taken * (x[step] - points[atom]).norm(dim=-1)
        total = self.full * len(points)
        cost = moved.new_zeros(paid.shape).index_add_(0, step, moved) / total
        value = pwil_value(
            cost, alpha=self.alpha, beta=self.beta, horizon=self.horizon, size=points.shape[1]
        )
        return torch.where(paid, value, 0.0).T

    def extra_repr(self) -> str:
        """Shows T, alpha and beta when printed."""
        return f"horizon={self.horizon}, alpha={self.alpha}, beta={self.beta}"


def pwil_reward(
    settings: PWILConfig, env: EnvBase, pairs: TensorDictBase, *, seed: int = 0
) -> PWILReward:
    """PWIL's reward of a demonstration.

    Args:
        settings: its settings.
        env: the environment, for its specs and its time limit.
        pairs: the demonstrated transitions, batch ``(n,)``, of one episode or of several.
        seed: has no effect, for nothing is random.

    Raises:
        UserError: if observations are frames, or if neither the environment has a time limit nor
            the settings a horizon.

    Examples:
        >>> from tensordict import TensorDict
        >>> from giril_rl.config.schema import TaskConfig
        >>> from giril_rl.envs import make_env
        >>> env = make_env(TaskConfig(name="cartpole", env_id="CartPole-v1"), 2, seed=0)
        >>> s, a = torch.rand(9, 4), torch.zeros(9, dtype=torch.int64)
        >>> pairs = TensorDict({"observation": s, "action": a}, [9])
        >>> pwil_reward(PWILConfig(), env, pairs).horizon
        500
    """
    horizon = settings.horizon or getattr(env, "time_limit", None)
    if horizon is None:
        raise UserError(
            "PWIL spreads the demonstration over an episode's steps and the environment has no "
            "time limit: set reward.horizon."
        )
    reward = PWILReward(
        *spaces_of("PWIL", env, settings.use_actions),
        atoms=len(pairs),
        horizon=horizon,
        alpha=settings.alpha,
        beta=settings.beta,
    )
    return reward.fit(pairs)


register(
    Method(
        "pwil",
        "PWIL",
        GREEN,
        trained="never",
        settings=PWILConfig,
        build=pwil_reward,
        scope="trajectory",
        frames=False,
    )
)
