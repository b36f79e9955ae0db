"""The base of all transforms of one reward, and how they read a batch without changing it."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, TensorSpec
from torchrl.envs import Transform

from giril_rl.errors import UserError


class RewardTransform(Transform):
    """Reads the reward under one key and checks it.

    Args:
        reward_key: the reward, without the ``"next"``.
        out_keys: further keys that are written.

    Examples:
        >>> RewardTransform("prize").in_keys
        ['prize']
    """

    def __init__(self, reward_key: NestedKey, out_keys: Sequence[NestedKey] = ()) -> None:
        self.reward_key = unravel_key(reward_key)
        super().__init__(in_keys=[self.reward_key], out_keys=[self.reward_key, *out_keys])
        self._event: torch.Size | None = None

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        """Remembers the shape of one reward, against which each step is checked."""
        self._event = self._own(reward_spec).shape[len(reward_spec.shape) :]
        return reward_spec

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
    """A shallow copy of a batch and its ``"next"``, in which entries can be set safely.

    A replay buffer returns its storage itself where all of it is requested.

    Raises:
        UserError: if there is no ``"next"``.

    Examples:
        >>> from tensordict import TensorDict
        >>> batch = TensorDict({"next": {"reward": torch.zeros(2, 1)}}, [2])
        >>> _, next_td = copied(batch)
        >>> _ = next_td.set("reward", torch.ones(2, 1))
        >>> batch["next", "reward"].sum()
        tensor(0.)
    """
    batch = tensordict.copy()
    next_td = batch.get("next", None)
    if next_td is None:
        raise UserError("the batch has no ('next', ...) entries: give whole transitions.")
    return batch, next_td


def find_reward(next_td: TensorDictBase, key: NestedKey) -> Tensor | None:
    """The reward under a key; None if it is missing or not a tensor.

    Examples:
        >>> from tensordict import TensorDict
        >>> find_reward(TensorDict({"reward": None}, [2]), "reward")
    """
    reward = next_td.get(key, None)
    return reward if isinstance(reward, Tensor) else None


def split_mask(batch: TensorDictBase) -> Tensor | None:
    """The mask of split trajectories, False where they are padded; None where none were split.

    Collectors with ``split_trajs`` or ``trajs_per_batch`` write it, and
    :func:`torchrl.collectors.utils.split_trajectories`.

    Examples:
        >>> from tensordict import TensorDict
        >>> mask = torch.tensor([[True, False]])
        >>> split_mask(TensorDict({"collector": {"mask": mask}}, [1, 2]))
        tensor([[ True, False]])
    """
    mask = batch.get(("collector", "mask"), None)
    if mask is None and batch.get("traj_ids", None) is not None:
        mask = batch.get("mask", None)
    return mask
