"""Replaces the environment's reward by a learned one."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from itertools import chain

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Composite
from torchrl.envs import (
    Compose,
    NextObservationDelta,
    ObservationNorm,
    Transform,
    TransformedEnv,
    VecNorm,
    VecNormV2,
)
from torchrl.record.recorder import VideoRecorder

from giril_rl.errors import UserError
from giril_rl.transforms.reward_transform import (
    RewardTransform,
    copied,
    find_reward,
    split_mask,
    unbounded,
)

DEFAULT_OUT_KEY: NestedKey = ("next", "intrinsic_reward")
NORMALISERS = (ObservationNorm, VecNorm, VecNormV2)


class IntrinsicReward(RewardTransform):
    """Replaces each transition's reward by the output of a reward module.

    It gives the same numbers in an environment (step by step), on a batch (as a collector's
    ``postproc``, by far the fastest) and in a replay buffer. The module gets only its own
    ``in_keys``, in eval mode and without gradient, and only its reward is used. It may be on
    another device than the batch. The batch does not change: a shallow copy is returned, so that a
    replay buffer keeps what it stores. The padding of split trajectories gets reward 0.

    The true reward moves to ``("next", extrinsic_key)`` and is not read. In an environment, that
    key is in the observation spec (zero at reset), because code that expects one reward key fails
    with two; keep it out of a policy's ``in_keys``.

    In an environment, put it after all transforms that change observations which it reads: it sees
    their output. It sees the base environment's action. Put it outside a
    :class:`~torchrl.envs.ParallelEnv`, whose workers hold copies of the module that later training
    does not reach. :class:`~giril_rl.transforms.RewardWeightSyncScheme` sends new weights to the
    copies in a multi-process collector.

    A module whose reward depends on an episode's earlier steps says ``along_time = True``, such as
    :class:`giril_rl.rewards.TrajectoryReward`. It gets batches ``(*environments, time)``; in an
    environment, one moment of all environments at a time. Split trajectories are refused, and so is
    a place inside a worker, which sees one environment only. It also gets those of its
    ``optional_keys`` that are there.

    Args:
        module: reads ``(s, a, s')``, e.g. ``"observation"``, ``"action"`` and
            ``("next", "observation")``; writes ``("next", "intrinsic_reward")``, shape
            ``(*batch, 1)``, or its only ``out_keys``.
        reward_key: the environment's reward, without the ``"next"``.
        extrinsic_key: where the true reward goes, without the ``"next"``; None drops it.

    Raises:
        UserError: if the module's keys, the reward's key or the new reward's shape do not fit, if
            ``extrinsic_key`` exists already, or if a later transform changes an observation that
            the module reads.

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
        parts = [part for part in module.modules() if getattr(part, "along_time", False)]
        self.along_time = self.needs_all_environments = bool(parts)
        self._optional_keys = [key for part in parts for key in getattr(part, "optional_keys", ())]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Relabels a batch ``[N, T]`` or ``[B]``; returns a shallow copy."""
        batch, next_td = copied(tensordict)
        if self.extrinsic_key is not None and next_td.get(self.extrinsic_key, None) is not None:
            raise UserError(
                f"the batch has {('next', self.extrinsic_key)} already, the true reward that an "
                "earlier relabelling kept: give the batch as it was collected, another "
                "extrinsic_key, or extrinsic_key=None to leave that one as it is."
            )
        true_reward = find_reward(next_td, self.reward_key)
        there = [key for key in self._optional_keys if batch.get(key, None) is not None]
        view = batch.select(*self.module.in_keys, *there)
        mask = split_mask(batch)
        if self.along_time and mask is not None:
            raise UserError(
                "the batch holds split trajectories and this reward follows each environment along "
                "time: collect with split_trajs=False."
            )
        self._relabel(view, next_td, true_reward, mask)
        return batch

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        view = TensorDict(batch_size=tensordict.batch_size, device=tensordict.device)
        for key in (*self.module.in_keys, *self._optional_keys):
            path = key if isinstance(key, tuple) else (key,)
            of_next = path[0] == "next"
            entry = next_tensordict.get(path[1:], None) if of_next else tensordict.get(key, None)
            if entry is not None or key not in self._optional_keys:
                view.set(key, entry)
        if self.along_time:
            view = (view if view.ndim else view.unsqueeze(0)).unsqueeze(-1)
        self._relabel(view, next_tensordict, self._read_step(next_tensordict))
        return next_tensordict

    def _relabel(
        self,
        view: TensorDictBase,
        next_td: TensorDictBase,
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
        shape = (*next_td.batch_size, 1) if true_reward is None else tuple(true_reward.shape)
        if view.batch_size != next_td.batch_size:  # A single moment.
            reward = reward.reshape(shape)
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
            next_td.set(self.extrinsic_key, true_reward)
        next_td.set(self.reward_key, reward)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        if self.extrinsic_key is not None:
            zero = unbounded(self._own(self.parent.full_reward_spec)).zero()
            tensordict_reset.set(self.extrinsic_key, zero)
        return tensordict_reset

    def train(self, mode: bool = True) -> IntrinsicReward:
        """Sets the transform's own mode and leaves the module's to its trainer.

        TorchRL puts every attached transform in eval mode, even while its module is trained.
        """
        self.training = mode
        return self

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        """The learned reward has the environment's shape and dtype, but no bounds."""
        super().transform_reward_spec(reward_spec)
        reward_spec[self.reward_key] = unbounded(self._own(reward_spec))
        return reward_spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Adds the true reward's new key, and checks the order of the transforms."""
        there = set(observation_spec.keys(True, True))
        if self.extrinsic_key is not None:
            rewards = self.parent.full_reward_spec
            if self.extrinsic_key in there.union(rewards.keys(True, True)):
                raise UserError(
                    f"the environment has {self.extrinsic_key!r} already: give another "
                    "extrinsic_key, so that no true reward is lost, or None to keep no more."
                )
            observation_spec[self.extrinsic_key] = unbounded(self._own(rewards))
        if self.container is not None:
            _check_order(self.container, self, self.module.in_keys, there)
        return observation_spec


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


def _check_order(
    env: TransformedEnv, reward: Transform, in_keys: Collection[NestedKey], there: set[NestedKey]
) -> None:
    """Refuses an order in which a reward would see s and s' changed by different transforms.

    s' has passed the transforms before the reward. s comes from the last step and has passed all
    transforms, except those that TorchRL inverts on the way to the environment. A warning says
    where the reward sees observations normalised on the fly, because a demonstration's often are
    not.
    """
    chain = list(_flat(env.transform))
    place = next((i for i, part in enumerate(chain) if part is reward), None)
    if place is None:
        return
    read = [unravel_key(key) for key in in_keys]
    for key in there.intersection(read):
        changing = [part for part in chain if _changes(part, key)]
        before = [part for part in chain[:place] if part in changing]
        s = [part for part in changing if key not in part.in_keys_inv]
        if s != before:
            odd = next(part for part in changing if (part in s) != (part in before))
            name = type(odd).__name__
            if odd in s:
                raise UserError(
                    f"{name} changes {key!r} after the reward, which would see a changed s and an "
                    f"unchanged s': put {name} before the reward, or let it write another key "
                    "(out_keys)."
                )
            raise UserError(
                f"{name} changes {key!r} before the reward and is inverted on the way to the "
                "environment (in_keys_inv), so that the reward would see an unchanged s and a "
                f"changed s': put {name} after the reward, or let it write another key (out_keys)."
            )
        for part in before:
            if not isinstance(part, NORMALISERS) or key not in part.in_keys:
                continue
            name = type(part).__name__
            warnings.warn(
                f"the reward stands after {name} and sees normalised {key!r}: fit it on "
                f"transitions of this environment, or, for a raw demonstration, let {name} write "
                "another key (out_keys) for the policy.",
                UserWarning,
                stacklevel=2,
            )


def _flat(transform: Transform) -> Iterator[Transform]:
    if isinstance(transform, Compose):
        for part in transform:
            yield from _flat(part)
    else:
        yield transform


def _changes(part: Transform, key: NestedKey) -> bool:
    # These two list observations in their out_keys but do not change them.
    if isinstance(part, NextObservationDelta | VideoRecorder):
        return False
    return key in part.out_keys


def device_of(module: nn.Module) -> torch.device | None:
    """Where a module's parameters or buffers are; None if it has neither."""
    state = next(chain(module.parameters(), module.buffers()), None)
    return None if state is None else state.device


@contextmanager
def eval_mode(module: nn.Module) -> Iterator[None]:
    """Puts a module in eval mode, and each part back in its own mode afterwards."""
    training = [part for part in module.modules() if part.training]
    if training:
        module.eval()
    try:
        yield
    finally:
        for part in training:
            part.training = True
