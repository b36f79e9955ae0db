"""One reward for all environments of a step: their mean."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torchrl.envs import Transform

from giril_rl.errors import UserError


class BatchMeanReward(Transform):
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

    Examples:
        >>> from tensordict import TensorDict
        >>> reward = torch.tensor([[[1.0], [2.0]], [[3.0], [6.0]]])  # 2 environments, 2 steps
        >>> batch = BatchMeanReward()(TensorDict({"next": {"reward": reward}}, [2, 2]))
        >>> batch["next", "reward"].squeeze(-1).tolist()
        [[2.0, 4.0], [2.0, 4.0]]
    """

    def __init__(self, reward_key: NestedKey = "reward", time_dim: int = -1) -> None:
        self.reward_key = unravel_key(reward_key)
        super().__init__(in_keys=[self.reward_key], out_keys=[self.reward_key])
        self.time_dim = time_dim

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Averages a batch ``[N, T]`` in place, step by step, and returns it."""
        dims = list(range(tensordict.ndim))
        if dims:
            dims.pop(self.time_dim)
        self._average(tensordict, ("next", self.reward_key), dims)
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        dims = list(range(next_tensordict.ndim))
        self._average(next_tensordict, self.reward_key, dims)
        return next_tensordict

    def _average(self, tensordict: TensorDictBase, key: NestedKey, dims: list[int]) -> None:
        reward = tensordict.get(unravel_key(key))
        if dims:
            mean = reward.mean(dims, keepdim=True)
            tensordict.set(unravel_key(key), torch.empty_like(reward).copy_(mean))

    def _check_batched_worker_compat(self) -> None:
        raise UserError(
            "BatchMeanReward inside a worker sees one environment only: put it outside, "
            "TransformedEnv(ParallelEnv(...), BatchMeanReward())."
        )
