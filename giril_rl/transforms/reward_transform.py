"""What the transforms of a reward have in common: they copy a batch and read its reward."""

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
    """Reads the reward under one key, and says in one sentence what is wrong with it.

    Args:
        reward_key: the reward, without the ``"next"``.
        out_keys: what is written beside the reward.

    Examples:
        >>> RewardTransform("prize").in_keys
        ['prize']
    """

    def __init__(self, reward_key: NestedKey, out_keys: Sequence[NestedKey] = ()) -> None:
        self.reward_key = unravel_key(reward_key)
        super().__init__(in_keys=[self.reward_key], out_keys=[self.reward_key, *out_keys])
        self._event: torch.Size | None = None

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        """Notes the shape of one reward, which each step is held to."""
        self._event = self._own(reward_spec).shape[len(reward_spec.shape) :]
        return reward_spec

    def _own(self, reward_spec: Composite) -> TensorSpec:
        keys = list(reward_spec.keys(True, True))
        if self.reward_key not in keys:
            raise UserError(
                f"the environment has no reward {self.reward_key!r}: choose one of {keys}."
            )
        return reward_spec[self.reward_key]

    def _read(self, following: TensorDictBase) -> Tensor:
        reward = find_reward(following, self.reward_key)
        if reward is None:
            raise UserError(
                f"there is no reward under ('next', {self.reward_key!r}): name its reward_key, or "
                "let the environment give one at every step."
            )
        return reward

    def _read_step(self, following: TensorDictBase) -> Tensor:
        reward = self._read(following)
        if self._event is not None and reward.shape[following.ndim :] != self._event:
            raise UserError(
                f"the environment's reward {self.reward_key!r} has shape {tuple(reward.shape)} "
                f"where its spec says {(*following.batch_size, *self._event)}: mend one of them."
            )
        return reward


def copied(tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
    """A shallow copy of a batch, and its ``"next"``: what is set in them changes no stored data.

    A replay buffer hands out its storage itself where all of it is asked for.

    Raises:
        UserError: if there is no ``"next"``.

    Examples:
        >>> from tensordict import TensorDict
        >>> batch = TensorDict({"next": {"reward": torch.zeros(2, 1)}}, [2])
        >>> _, following = copied(batch)
        >>> _ = following.set("reward", torch.ones(2, 1))
        >>> batch["next", "reward"].sum()
        tensor(0.)
    """
    batch = tensordict.copy()
    following = batch.get("next", None)
    if following is None:
        raise UserError("the batch has no ('next', ...) entries: give whole transitions.")
    return batch, following


def find_reward(following: TensorDictBase, key: NestedKey) -> Tensor | None:
    """The reward under a key, None if there is none or it is no tensor (such as None).

    Examples:
        >>> from tensordict import TensorDict
        >>> find_reward(TensorDict({"reward": None}, [2]), "reward")
    """
    reward = following.get(key, None)
    return reward if isinstance(reward, Tensor) else None


def split_mask(batch: TensorDictBase) -> Tensor | None:
    """What TorchRL writes where trajectories lie one below the other: False where padded.

    Collectors with ``split_trajs`` or ``trajs_per_batch``, and
    :func:`torchrl.collectors.utils.split_trajectories`.

    Returns:
        The mask, or None for a batch whose trajectories were not split.

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
