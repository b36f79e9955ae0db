"""The base of all transforms of one reward, and how they read a batch without changing it."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Transform

from giril_rl.errors import UserError


class RewardTransform(Transform):
    """Reads the reward under one key and checks it.

    Args:
        reward_key: the reward, without the ``"next"``.
        out_keys: further keys that are written.
    """

    needs_all_environments: bool = False
    """Whether it refuses to run inside a worker, which sees one environment only."""

    def __init__(self, reward_key: NestedKey, out_keys: Sequence[NestedKey] = ()) -> None:
        self.reward_key = unravel_key(reward_key)
        super().__init__(in_keys=[self.reward_key], out_keys=[self.reward_key, *out_keys])
        self._event: torch.Size | None = None

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        """Remembers the shape of one reward, against which each step is checked."""
        self._event = self._own(reward_spec).shape[len(reward_spec.shape) :]
        return reward_spec

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._reset(tensordict, tensordict_reset)

    def _check_batched_worker_compat(self) -> None:
        if self.needs_all_environments:
            name = type(self).__name__
            raise UserError(
                f"{name} inside a worker sees one environment only: put it outside, "
                f"TransformedEnv(ParallelEnv(...), {name}())."
            )

    def _own(self, reward_spec: Composite) -> TensorSpec:
        keys = list(reward_spec.keys(True, True))
        if self.reward_key not in keys:
            raise UserError(
                f"the environment has no reward {self.reward_key!r}: choose one of {keys}."
            )
        return reward_spec[self.reward_key]

    def _read(self, next_td: TensorDictBase) -> Tensor:
        reward = find_reward(next_td, self.reward_key)
        if reward is None:
            raise UserError(
                f"there is no reward under ('next', {self.reward_key!r}): name its reward_key, or "
                "let the environment give one at every step."
            )
        return reward

    def _read_step(self, next_td: TensorDictBase) -> Tensor:
        reward = self._read(next_td)
        if self._event is not None and reward.shape[next_td.ndim :] != self._event:
            raise UserError(
                f"the environment's reward {self.reward_key!r} has shape {tuple(reward.shape)} "
                f"where its spec says {(*next_td.batch_size, *self._event)}: mend one of them."
            )
        return reward


def copied(tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
    """A shallow copy of a batch and its ``"next"``: setting entries changes no stored data."""
    batch = tensordict.copy()
    next_td = batch.get("next", None)
    if next_td is None:
        raise UserError("the batch has no ('next', ...) entries: give whole transitions.")
    return batch, next_td


def find_reward(next_td: TensorDictBase, key: NestedKey) -> Tensor | None:
    """The reward under a key; None if it is missing or not a tensor."""
    reward = next_td.get(key, None)
    return reward if isinstance(reward, Tensor) else None


def split_mask(batch: TensorDictBase) -> Tensor | None:
    """The mask that collectors write for split trajectories, False where padded; else None."""
    mask = batch.get(("collector", "mask"), None)
    if mask is None and batch.get("traj_ids", None) is not None:
        mask = batch.get("mask", None)
    return mask


def unbounded(spec: TensorSpec) -> TensorSpec:
    """A spec of the same shape, dtype and device without bounds."""
    return Unbounded(shape=spec.shape, dtype=spec.dtype, device=spec.device)
