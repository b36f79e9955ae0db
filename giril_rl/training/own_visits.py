"""Telling a reward of the policy's own visits, with each batch that it collects."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase

from giril_rl.rewards.mmd import MMDReward
from giril_rl.runs.randomness import stream_seed

MEASURED_EVERY = 1_000
"""Environment steps between two measurements of the MMD, which cost as much as a minibatch."""


class VisitTrainer:
    """Keeps GMMIL's reward up to date with what the policy visits; nothing is trained.

    A :class:`~giril_rl.training.RewardTrainer`. The visits are in the reward's own state, which is
    in the checkpoint of the transform that holds it, and here once more.

    Args:
        reward: told of each batch.
        seed: seeds which of all visits are kept; the global random state is left alone.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> reward = MMDReward.for_vectors(2, Bounded(-1, 1, shape=(1,)), atoms=50, every=1)
        >>> pairs = lambda *n: TensorDict(
        ...     {"observation": torch.randn(*n, 2), "action": torch.zeros(*n, 1)}, n
        ... )
        >>> reward.remember(pairs(50))
        >>> VisitTrainer(reward, seed=0).update(pairs(4, 16))  # 4 environments, 16 steps
        {'mmd/squared': 0.0..., 'mmd/visits': 64.0}
    """

    def __init__(self, reward: MMDReward, *, seed: int) -> None:
        self.reward = reward
        self._generator = torch.Generator().manual_seed(stream_seed("reward", seed))

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Tells the reward of a batch ``(num_envs, time)``.

        Returns:
            The squared MMD between demonstration and visits, and how many are kept; at the first
            batch and then about every 1,000 environment steps, otherwise nothing.
        """
        before = int(self.reward.seen)
        self.reward.observe(batch, self._generator)
        if before and before // MEASURED_EVERY == int(self.reward.seen) // MEASURED_EVERY:
            return {}
        return {
            "mmd/squared": self.reward.squared_mmd().item(),
            "mmd/visits": float((self.reward.weights > 0).sum()),
        }

    def state_dict(self) -> dict[str, Any]:
        """The reward with its visits, and the random state."""
        return {"reward": dict(self.reward.state_dict()), "generator": self._generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` gave."""
        self.reward.load_state_dict(state["reward"])
        self._generator.set_state(state["generator"])
