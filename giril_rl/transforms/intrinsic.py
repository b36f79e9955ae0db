"""A learned reward in the place of the environment's."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Transform

from giril_rl.errors import UserError

DEFAULT_OUT_KEY: NestedKey = ("next", "intrinsic_reward")


class IntrinsicReward(Transform):
    """Replaces the reward of each transition by what a reward module makes of it.

    The same numbers come out in an environment (step by step), on a batch (as a collector's
    ``postproc``, by far the fastest) and in a replay buffer. The module may be on another device
    than the batch: what it reads is copied there, and the reward back. It is given only its own
    ``in_keys``, in eval mode and without gradient; of what it writes, only the reward is taken.
    The true reward moves to ``("next", extrinsic_key)`` and is not read. In an environment that key
    stands in the observation spec (zero at reset), because a second reward key would break code
    that expects one; it must then not be among a policy's ``in_keys``.

    In an environment, put it outside a :class:`~torchrl.envs.ParallelEnv`: workers hold copies of
    the module, which later training of the original does not reach. Copies in the environments of
    a multi-process collector get new weights by
    :class:`~giril_rl.transforms.RewardWeightSyncScheme`.

    Args:
        module: reads ``(s, a, s')``, e.g. ``"observation"``, ``"action"`` and
            ``("next", "observation")``, and writes ``("next", "intrinsic_reward")``, shape
            ``(*batch, 1)``, or the only key that it has in ``out_keys``.
        reward_key: the environment's reward, without the ``"next"``.
        extrinsic_key: where the true reward goes, without the ``"next"``; None drops it.

    Raises:
        UserError: if the module's keys, the reward's key or the new reward's shape do not fit.

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
        self.reward_key = unravel_key(reward_key)
        self.extrinsic_key = None if extrinsic_key is None else unravel_key(extrinsic_key)
        if self.extrinsic_key == self.reward_key:
            raise UserError(
                f"extrinsic_key and reward_key are both {reward_key!r}: give the true reward "
                "another key."
            )
        kept = [] if self.extrinsic_key is None else [self.extrinsic_key]
        super().__init__(in_keys=[self.reward_key], out_keys=[self.reward_key, *kept])
        self._result_key = _result_key(module)
        self.module = module

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Relabels a batch ``[N, T]`` or ``[B]`` in place and returns it."""
        view = tensordict.select(*self.module.in_keys)
        following = tensordict.get("next", None)
        if following is None:
            raise UserError("the batch has no ('next', ...) entries: give whole transitions.")
        self._relabel(view, following)
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        view = TensorDict(batch_size=tensordict.batch_size, device=tensordict.device)
        for key in self.module.in_keys:
            path = key if isinstance(key, tuple) else (key,)
            if path[0] == "next":
                view.set(key, next_tensordict.get(path[1:]))
            else:
                view.set(key, tensordict.get(key))
        self._relabel(view, next_tensordict)
        return next_tensordict

    def _relabel(self, view: TensorDictBase, following: TensorDictBase) -> None:
        weight = next(self.module.parameters(), None)
        read = [view.get(key) for key in self.module.in_keys]
        if weight is not None and any(x.device != weight.device for x in read):
            view = view.to(weight.device)
        with torch.no_grad(), eval_mode(self.module):
            reward: Tensor = self.module(view).get(self._result_key).detach()
        true_reward = following.get(self.reward_key, None)
        if true_reward is not None:
            if reward.shape != true_reward.shape:
                raise UserError(
                    f"the reward module gave shape {tuple(reward.shape)} where the reward has "
                    f"{tuple(true_reward.shape)}: write one value per transition."
                )
            reward = reward.to(device=true_reward.device, dtype=true_reward.dtype)
        if self.extrinsic_key is not None:
            if true_reward is None:
                raise UserError(
                    f"the batch has no reward under ('next', {self.reward_key!r}): name its "
                    "reward_key, or give extrinsic_key=None if there is none to keep."
                )
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
        reward_spec[self.reward_key] = self._unbounded(reward_spec)
        return reward_spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Announces the true reward under its new key."""
        if self.extrinsic_key is not None:
            spec = self._unbounded(self.parent.full_reward_spec)
            observation_spec[self.extrinsic_key] = spec
        return observation_spec

    def _unbounded(self, reward_spec: Composite) -> TensorSpec:
        keys = list(reward_spec.keys(True, True))
        if self.reward_key not in keys:
            raise UserError(
                f"the environment has no reward {self.reward_key!r}: choose one of {keys}."
            )
        spec = reward_spec[self.reward_key]
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
