"""The mean of a step's rewards over the environments."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from giril_rl.errors import UserError
from giril_rl.transforms.reward_transform import RewardTransform, copied, split_mask


class BatchMeanReward(RewardTransform):
    """Replaces a step's reward by its mean over the environments.

    The released GIRIL code averages eq. 2 over the parallel environments too (its
    ``reduction="mean"``), so that a reward no longer says what its own environment did. As a
    transform of its own, the effect can be measured.

    In an environment, all batch dimensions are environments. In a batch, ``time_dim`` is time and
    the other dimensions are environments; a flat batch is the time of one environment and does not
    change. The transform refuses to run inside a worker, which sees one environment only.

    Args:
        reward_key: the reward, without the ``"next"``.
        time_dim: which of the batch dimensions is time.

    Raises:
        UserError: if the reward is missing or does not have its spec's shape, and for split
            trajectories, whose steps are not simultaneous.

    Examples:
        >>> from tensordict import TensorDict
        >>> reward = torch.tensor([[[1.0], [2.0]], [[3.0], [6.0]]])  # 2 environments, 2 steps
        >>> batch = BatchMeanReward()(TensorDict({"next": {"reward": reward}}, [2, 2]))
        >>> batch["next", "reward"].squeeze(-1).tolist()
        [[2.0, 4.0], [2.0, 4.0]]
    """

    needs_all_environments = True

    def __init__(self, reward_key: NestedKey = "reward", time_dim: int = -1) -> None:
        super().__init__(reward_key)
        self.time_dim = time_dim

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Averages a batch ``[N, T]`` step by step; returns a shallow copy."""
        batch, next_td = copied(tensordict)
        if split_mask(batch) is not None:
            raise UserError(
                "the batch holds split trajectories, whose steps are not those of one time: "
                "collect with split_trajs=False."
            )
        dims = list(range(batch.ndim))
        if dims:
            dims.pop(self.time_dim)
        self._average(next_td, self._read(next_td), dims)
        return batch

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        dims = list(range(next_tensordict.ndim))
        self._average(next_tensordict, self._read_step(next_tensordict), dims)
        return next_tensordict

    def _average(self, next_td: TensorDictBase, reward: Tensor, dims: list[int]) -> None:
        if dims:
            mean = reward.mean(dims, keepdim=True)
            next_td.set(self.reward_key, torch.empty_like(reward).copy_(mean))
