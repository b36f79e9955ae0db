"""One reward for all environments of a step: their mean."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from giril_rl.errors import UserError
from giril_rl.transforms.reward_transform import RewardTransform, copied, split_mask


class BatchMeanReward(RewardTransform):
    """Replaces a step's reward by its mean over the environments.

    The released GIRIL code averages eq. 2 over the parallel environments as well (its
    ``reduction="mean"``), so that a step's reward no longer tells what this environment did.
    Kept apart from the reward so that its effect can be measured.

    In an environment all batch dimensions are environments. In a batch, ``time_dim`` is time and
    the other dimensions are environments; a flat batch is one environment's time and stays as it
    is. Inside a worker of a batched environment there is one environment only, and the transform
    refuses.

    Args:
        reward_key: the reward, without the ``"next"``.
        time_dim: which of the batch dimensions is time.

    Raises:
        UserError: if there is no reward, for one of another shape than the environment's spec says,
            and for split trajectories, which are not side by side in time.

    Examples:
        >>> from tensordict import TensorDict
        >>> reward = torch.tensor([[[1.0], [2.0]], [[3.0], [6.0]]])  # 2 environments, 2 steps
        >>> batch = BatchMeanReward()(TensorDict({"next": {"reward": reward}}, [2, 2]))
        >>> batch["next", "reward"].squeeze(-1).tolist()
        [[2.0, 4.0], [2.0, 4.0]]
    """

    def __init__(self, reward_key: NestedKey = "reward", time_dim: int = -1) -> None:
        super().__init__(reward_key)
        self.time_dim = time_dim

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Averages a batch ``[N, T]`` step by step and returns it, as a shallow copy."""
        batch, following = copied(tensordict)
        if split_mask(batch) is not None:
            raise UserError(
                "the batch holds split trajectories, whose steps are not those of one time: "
                "collect with split_trajs=False."
            )
        dims = list(range(batch.ndim))
        if dims:
            dims.pop(self.time_dim)
        self._average(following, self._read(following), dims)
        return batch

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        dims = list(range(next_tensordict.ndim))
        self._average(next_tensordict, self._read_step(next_tensordict), dims)
        return next_tensordict

    def _average(self, following: TensorDictBase, reward: Tensor, dims: list[int]) -> None:
        if dims:
            mean = reward.mean(dims, keepdim=True)
            following.set(self.reward_key, torch.empty_like(reward).copy_(mean))

    def _check_batched_worker_compat(self) -> None:
        raise UserError(
            "BatchMeanReward inside a worker sees one environment only: put it outside, "
            "TransformedEnv(ParallelEnv(...), BatchMeanReward())."
        )
