"""The weighted sum of several rewards."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs import Transform

from giril_rl.errors import UserError
from giril_rl.transforms.reward_transform import copied, find_reward, unbounded


class WeightedReward(Transform):
    """Replaces the reward by a weighted sum of rewards under several keys.

    Put it after :class:`~giril_rl.transforms.IntrinsicReward`, which leaves the learned reward
    under ``"reward"`` and the true one under ``"extrinsic_reward"``: then
    ``WeightedReward({"reward": 0.8, "extrinsic_reward": 0.2})`` is 0.8 times the learned reward
    plus 0.2 times the true one. The sum replaces the term under ``reward_key``; other terms stay.
    A term with weight 0 is not read, so that it may be NaN or missing.

    It gives the same numbers in an environment (also inside a worker), on a batch and in a replay
    buffer. In an environment a term may be a reward or an observation. Further rewards that it
    reads become observations (zero at reset), because code that expects one reward key fails with
    two; keep them out of a policy's ``in_keys``. ``weights`` may be changed later.

    Args:
        weights: maps each term's key, without the ``"next"``, to its weight. All terms have the
            same shape.
        reward_key: where the sum is written, without the ``"next"``.

    Raises:
        UserError: if there are no weights or one is not finite, or if terms are missing or differ
            in shape.

    Examples:
        >>> from tensordict import TensorDict
        >>> rewards = {"reward": torch.tensor([[1.0]]), "extrinsic_reward": torch.tensor([[10.0]])}
        >>> batch = TensorDict({"next": rewards}, [1])
        >>> batch = WeightedReward({"reward": 0.8, "extrinsic_reward": 0.2})(batch)
        >>> batch["next", "reward"], batch["next", "extrinsic_reward"]
        (tensor([[2.8000]]), tensor([[10.]]))
    """

    def __init__(
        self, weights: Mapping[NestedKey, float], *, reward_key: NestedKey = "reward"
    ) -> None:
        if not weights:
            raise UserError('no weights: give a weight for each reward, such as {"reward": 1.0}.')
        for key, weight in weights.items():
            if not math.isfinite(weight):
                raise UserError(f"the weight of {key!r} is {weight}: give a finite number.")
        self.weights = {unravel_key(key): float(weight) for key, weight in weights.items()}
        self.reward_key = unravel_key(reward_key)
        super().__init__(in_keys=list(self.weights), out_keys=[self.reward_key])

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the sum for a batch of any shape; returns a shallow copy."""
        batch, next_td = copied(tensordict)
        self._sum(next_td)
        return batch

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._sum(next_tensordict)

    def _sum(self, next_td: TensorDictBase) -> TensorDictBase:
        total: Tensor | None = None
        like = find_reward(next_td, self.reward_key)
        for key, weight in self.weights.items():
            if weight == 0:
                continue
            term = find_reward(next_td, key)
            if term is None:
                raise UserError(f"there is no reward under ('next', {key!r}): name another key.")
            like = term if like is None else like
            if term.shape != like.shape:
                raise UserError(
                    f"the reward {key!r} has shape {tuple(term.shape)} where another has "
                    f"{tuple(like.shape)}: give all the same."
                )
            term = weight * term.to(device=like.device, dtype=like.dtype)
            total = term if total is None else total + term
        if total is None:
            if like is None:
                raise UserError("all weights are 0 and there is no reward: give a weight.")
            total = torch.zeros_like(like)
        return next_td.set(self.reward_key, total)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        rewards = self.parent.full_reward_spec
        for key in self._moved(rewards):
            tensordict_reset.set(key, unbounded(rewards[key]).zero())
        return tensordict_reset

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._reset(tensordict, tensordict_reset)

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        """The sum has no bounds; further rewards that it reads are removed."""
        observations = self.parent.full_observation_spec
        keys = {*reward_spec.keys(True, True), *observations.keys(True, True)}
        missing = [key for key in self.weights if key not in keys]
        if missing:
            raise UserError(f"the environment has no {missing[0]!r}: choose one of {list(keys)}.")
        first = next(iter(self.weights))
        for key in (self.reward_key, first):
            spec = reward_spec if key in reward_spec.keys(True, True) else observations
            if key in spec.keys(True, True):
                total = unbounded(spec[key])
                break
        for key in self._moved(reward_spec):
            del reward_spec[key]
        reward_spec[self.reward_key] = total
        return reward_spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Adds the further rewards that it reads."""
        rewards = self.parent.full_reward_spec
        for key in self._moved(rewards):
            observation_spec[key] = unbounded(rewards[key])
        return observation_spec

    def _moved(self, reward_spec: Composite) -> list[NestedKey]:
        rewards = list(reward_spec.keys(True, True))
        return [key for key in self.weights if key in rewards and key != self.reward_key]
