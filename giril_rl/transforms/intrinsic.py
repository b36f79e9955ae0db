"""A learned reward in the place of the environment's."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec, Unbounded

from giril_rl.errors import UserError
from giril_rl.transforms.order import check_order
from giril_rl.transforms.reward_transform import RewardTransform, copied, find_reward, split_mask

DEFAULT_OUT_KEY: NestedKey = ("next", "intrinsic_reward")


class IntrinsicReward(RewardTransform):
    """Replaces the reward of each transition by what a reward module makes of it.

    The same numbers come out in an environment (step by step), on a batch (as a collector's
    ``postproc``, by far the fastest) and in a replay buffer. The module may be on another device
    than the batch: what it reads is copied there, and the reward back. It is given only its own
    ``in_keys``, in eval mode and without gradient; of what it writes, only the reward is taken.
    A batch is not changed: a shallow copy of it is returned, so that a replay buffer keeps what it
    stores. Where trajectories were split and padded, the padding's reward is 0.

    The true reward moves to ``("next", extrinsic_key)`` and is not read. In an environment that key
    stands in the observation spec (zero at reset), because a second reward key would break code
    that expects one; it must then not be among a policy's ``in_keys``.

    In an environment, it stands after all transforms that change observations which it reads, and
    sees what they make of them; its action is the base environment's. Put it outside a
    :class:`~torchrl.envs.ParallelEnv`: workers hold copies of the module, which later training of
    the original does not reach. Copies in the environments of a multi-process collector get new
    weights by :class:`~giril_rl.transforms.RewardWeightSyncScheme`.

    Args:
        module: reads ``(s, a, s')``, e.g. ``"observation"``, ``"action"`` and
            ``("next", "observation")``, and writes ``("next", "intrinsic_reward")``, shape
            ``(*batch, 1)``, or the only key that it has in ``out_keys``.
        reward_key: the environment's reward, without the ``"next"``.
        extrinsic_key: where the true reward goes, without the ``"next"``; None drops it.

    Raises:
        UserError: if the module's keys, the reward's key or the new reward's shape do not fit, if
            there is something under ``extrinsic_key`` already, or if a later transform changes an
            observation that the module reads.

    Examples:
        >>> from giril_rl.rewards import ConstantReward
        >>> batch = TensorDict({"next": {"reward": torch.tensor([[5.0], [7.0]])}}, [2])
        >>> batch = IntrinsicReward(ConstantReward(1.0))(batch)
        >>> batch["next", "reward"].tolist(), batch["next", "extrinsic_reward"].tolist()
        ([[1.0], [1.0]], [[5.0], [7.0]])
    """

    def __init__(
        self,
        module: TensorDictModuleBase,
        *,
        reward_key: NestedKey = "reward",
        extrinsic_key: NestedKey | None = "extrinsic_reward",
    ) -> None:
        self.extrinsic_key = None if extrinsic_key is None else unravel_key(extrinsic_key)
        if self.extrinsic_key == unravel_key(reward_key):
            raise UserError(
                f"extrinsic_key and reward_key are both {reward_key!r}: give the true reward "
                "another key."
            )
        kept = [] if self.extrinsic_key is None else [self.extrinsic_key]
        super().__init__(reward_key, kept)
        self._result_key = _result_key(module)
        self.module = module

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Relabels a batch ``[N, T]`` or ``[B]`` and returns it, as a shallow copy."""
        batch, following = copied(tensordict)
        if self.extrinsic_key is not None and following.get(self.extrinsic_key, None) is not None:
            raise UserError(
                f"the batch has {('next', self.extrinsic_key)} already, the true reward that an "
                "earlier relabelling kept: give the batch as it was collected, another "
                "extrinsic_key, or extrinsic_key=None to leave that one as it is."
            )
        true_reward = find_reward(following, self.reward_key)
        view = batch.select(*self.module.in_keys)
        self._relabel(view, following, true_reward, split_mask(batch))
        return batch

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        view = TensorDict(batch_size=tensordict.batch_size, device=tensordict.device)
        for key in self.module.in_keys:
            path = key if isinstance(key, tuple) else (key,)
            if path[0] == "next":
                view.set(key, next_tensordict.get(path[1:]))
            else:
                view.set(key, tensordict.get(key))
        self._relabel(view, next_tensordict, self._read_step(next_tensordict))
        return next_tensordict

    def _relabel(
        self,
        view: TensorDictBase,
        following: TensorDictBase,
        true_reward: Tensor | None,
        mask: Tensor | None = None,
    ) -> None:
        if true_reward is None and self.extrinsic_key is not None:
            raise UserError(
                f"the batch has no reward under ('next', {self.reward_key!r}): name its "
                "reward_key, or give extrinsic_key=None if there is none to keep."
            )
        device = device_of(self.module)
        read = [view.get(key) for key in self.module.in_keys]
        if device is not None and any(x.device != device for x in read):
            view = view.to(device)
        with torch.no_grad(), eval_mode(self.module):
            reward = find_reward(self.module(view), self._result_key)
        if reward is None:
            raise UserError(f"the reward module wrote no tensor under {self._result_key!r}.")
        shape = (*following.batch_size, 1) if true_reward is None else tuple(true_reward.shape)
        if reward.shape != shape:
            raise UserError(
                f"the reward module gave shape {tuple(reward.shape)} where the reward has "
                f"{shape}: write one value per transition."
            )
        reward = reward.detach()
        if true_reward is not None:
            reward = reward.to(device=true_reward.device, dtype=true_reward.dtype)
        elif read:
            reward = reward.to(read[0].device)
        if mask is not None:
            while mask.ndim < reward.ndim:
                mask = mask.unsqueeze(-1)
            reward = torch.where(mask, reward, 0.0)
        if self.extrinsic_key is not None:
            following.set(self.extrinsic_key, true_reward)
        following.set(self.reward_key, reward)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        if self.extrinsic_key is not None:
            zero = self._unbounded(self.parent.full_reward_spec).zero()
            tensordict_reset.set(self.extrinsic_key, zero)
        return tensordict_reset

    def train(self, mode: bool = True) -> IntrinsicReward:
        """Sets the transform's own mode; the module's mode is its trainer's business.

        TorchRL puts a transform in eval mode wherever it is attached, and would stop a reward
        module that is still being trained from training.
        """
        self.training = mode
        return self

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._reset(tensordict, tensordict_reset)

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        """A learned reward has the environment's shape and dtype, but no bounds."""
        super().transform_reward_spec(reward_spec)
        reward_spec[self.reward_key] = self._unbounded(reward_spec)
        return reward_spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Announces the true reward under its new key, where every transform is in its place."""
        there = set(observation_spec.keys(True, True))
        if self.extrinsic_key is not None:
            rewards = self.parent.full_reward_spec
            if self.extrinsic_key in there.union(rewards.keys(True, True)):
                raise UserError(
                    f"the environment has {self.extrinsic_key!r} already: give another "
                    "extrinsic_key, so that no true reward is lost, or None to keep no more."
                )
            observation_spec[self.extrinsic_key] = self._unbounded(rewards)
        if self.container is not None:
            check_order(self.container, self, self.module.in_keys, there)
        return observation_spec

    def _unbounded(self, reward_spec: Composite) -> TensorSpec:
        spec = self._own(reward_spec)
        return Unbounded(shape=spec.shape, dtype=spec.dtype, device=spec.device)


def _result_key(module: nn.Module) -> NestedKey:
    if not isinstance(module, TensorDictModuleBase):
        raise UserError(
            f"{type(module).__name__} has no in_keys and out_keys: wrap it in a TensorDictModule."
        )
    out_keys = [unravel_key(key) for key in module.out_keys]
    if DEFAULT_OUT_KEY in out_keys:
        return DEFAULT_OUT_KEY
    if len(out_keys) != 1:
        raise UserError(
            f"the reward module writes {out_keys}: let it write {DEFAULT_OUT_KEY} or one key only."
        )
    return out_keys[0]


def device_of(module: nn.Module) -> torch.device | None:
    """Where a module's parameters are, or its buffers; None if it has neither.

    Examples:
        >>> device_of(nn.Linear(1, 1)), device_of(nn.Tanh())
        (device(type='cpu'), None)
    """
    state = next(chain(module.parameters(), module.buffers()), None)
    return None if state is None else state.device


@contextmanager
def eval_mode(module: nn.Module) -> Iterator[None]:
    """Puts a module in eval mode and every part of it back in the mode it was in.

    Examples:
        >>> with eval_mode(layer := nn.Dropout()):
        ...     layer.training
        False
        >>> layer.training
        True
    """
    training = [part for part in module.modules() if part.training]
    if training:
        module.eval()
    try:
        yield
    finally:
        for part in training:
            part.training = True
