"""The value of the absorbing state that a failure leads to."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from giril_rl.errors import UserError
from giril_rl.transforms.reward_transform import RewardTransform, copied


class AbsorbingReward(RewardTransform):
    """Adds ``gamma / (1 - gamma) * r_abs`` to the reward of each transition that ends in a failure.

    After a failure the agent stays in an absorbing state for ever and gets ``r_abs`` at each step.
    A learner takes nothing to follow a failure, so the sum of those rewards, discounted to the
    failure, is paid with its reward (Kostrikov et al. 2019, arXiv 1809.02925, section 4.1). Then
    neither a reward above 0 favours survival by itself, nor one below 0 a quick end. A time limit
    is no failure: only ``terminated`` counts, not ``truncated``.

    Put it after :class:`~giril_rl.transforms.IntrinsicReward` and before any scaling. It gives the
    same numbers in an environment, on a batch and in a replay buffer.

    Args:
        absorbing: computes ``r_abs``, a scalar, at each call, such as
            ``DiscriminatorReward.absorbing_reward``.
        gamma: the learner's discount, below 1.
        reward_key: the reward, without the ``"next"``.
        terminated_key: whether the step ended in a failure, without the ``"next"``.

    Raises:
        UserError: for a discount outside [0, 1), or a batch that does not say where it failed.

    Examples:
        >>> from tensordict import TensorDict
        >>> end = torch.tensor([[False], [True]])
        >>> batch = TensorDict({"next": {"reward": torch.ones(2, 1), "terminated": end}}, [2])
        >>> batch = AbsorbingReward(lambda: torch.tensor(-0.5), gamma=0.9)(batch)
        >>> batch["next", "reward"].flatten()
        tensor([ 1.0000, -3.5000])
    """

    def __init__(
        self,
        absorbing: Callable[[], Tensor],
        gamma: float,
        *,
        reward_key: NestedKey = "reward",
        terminated_key: NestedKey = "terminated",
    ) -> None:
        if not 0 <= gamma < 1:
            raise UserError(
                f"gamma={gamma}: an absorbing state's rewards have a finite sum for a discount in "
                "[0, 1) only; give one such as 0.99."
            )
        super().__init__(reward_key)
        self.absorbing = absorbing
        self.weight = gamma / (1 - gamma)
        self.terminated_key = terminated_key

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Adds it in a batch of any shape; returns a shallow copy."""
        batch, next_td = copied(tensordict)
        self._add(next_td, self._read(next_td))
        return batch

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._add(next_tensordict, self._read_step(next_tensordict))
        return next_tensordict

    def _add(self, next_td: TensorDictBase, reward: Tensor) -> None:
        terminated = next_td.get(self.terminated_key, None)
        if terminated is None:
            raise UserError(
                f"there is no ('next', {self.terminated_key!r}), which says where an episode "
                "failed: name its terminated_key."
            )
        value = self.weight * self.absorbing().to(device=reward.device, dtype=reward.dtype)
        next_td.set(
            self.reward_key, torch.where(terminated.reshape(reward.shape), reward + value, reward)
        )
