"""Divides rewards by the running standard deviation of their discounted return."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal, get_args

import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Bounded, Composite

from giril_rl.errors import UserError
from giril_rl.transforms.reward_transform import RewardTransform, copied, split_mask, unbounded
from giril_rl.transforms.running_return import discounted_filter, running_moments

ResetRule = Literal["never", "done"]

# OpenAI baselines' RunningMeanStd starts as if it had seen this many values, of variance 1.
INITIAL_COUNT = 1e-4


class NonFiniteReward(UserError):
    """A reward that is NaN, infinite or too large to be squared.

    Args:
        what: the reward and where it occurred.

    Examples:
        >>> raise NonFiniteReward("the reward is nan in environment 0 at step 5 of the batch")
        Traceback (most recent call last):
        giril_rl.transforms.scaling.NonFiniteReward: the reward is nan in environment 0 at step 5 of
        the batch: look at what it is computed from.
    """

    def __init__(self, what: str) -> None:
        super().__init__(f"{what}: look at what it is computed from.")
        self.what = what


class ReturnScaling(RewardTransform):
    """Divides the reward by the running standard deviation of ``R_t = gamma * R_{t-1} + r_t``.

    No mean is subtracted, so that a reward keeps its sign. The filter runs over time in each
    environment and continues from batch to batch. The reward of step t is divided by the standard
    deviation of all filtered returns up to and including step t, in all environments. A batch gets
    the same numbers as its steps one by one.

    Sources: Burda et al. 2018, "Large-Scale Study of Curiosity-Driven Learning" (arXiv
    1808.04355), and the same authors' RND, whose RewardForwardFilter never resets. With
    ``reset="done"`` as in OpenAI baselines' VecNormalize and Gymnasium's NormalizeReward, which
    reset the return at an episode's end. As in baselines, the moments start as if 1e-4 values of
    mean 0 and variance 1 had been seen, and the scaled reward is clipped.

    In an environment, all batch dimensions are environments. In a batch, ``time_dim`` is time and
    the other dimensions are environments; a flat batch is the time of one environment. The batch
    does not change: a shallow copy is returned. The transform refuses to run inside a worker, which
    sees one environment only, and to learn from split trajectories, whose steps are padded and not
    simultaneous.

    After :meth:`freeze`, rewards of any batch shape, shuffled or not, are divided by the present
    standard deviation. Eval mode does the same for batches, but not in an environment, because
    TorchRL puts every attached transform in eval mode.

    Args:
        gamma: discount of the filter, in [0, 1].
        reward_key: the reward, without the ``"next"``.
        reset: when the filter starts again: ``"never"``, or ``"done"`` for an episode's end and a
            manual reset of the environment.
        clip: scaled rewards are clipped to plus or minus this; None does not clip.
        eps: added to the variance.
        time_dim: which of the batch dimensions is time.
        done_key: the end of an episode, without the ``"next"``; only ``reset="done"`` reads it.

    Raises:
        UserError: for an invalid gamma, reset rule, clip or eps, for another number of environments
            than before, or if frozen before anything was learned.
        NonFiniteReward: for a reward that is NaN, infinite or too large to be squared, with its
            environment and step. Nothing is learned from its batch. A compiled graph cannot raise:
            it learns nothing and gives NaN.

    Examples:
        >>> from tensordict import TensorDict
        >>> scaling = ReturnScaling(gamma=0.0)
        >>> reward = torch.tensor([[[1.0]], [[-1.0]], [[3.0]], [[-3.0]]])  # 4 environments, 1 step
        >>> batch = scaling(TensorDict({"next": {"reward": reward}}, [4, 1]))
        >>> batch["next", "reward"].flatten()  # divided by nearly the root of 5
        tensor([ 0.4472, -0.4472,  1.3417, -1.3417])
    """

    needs_all_environments = True
    count: Tensor
    mean: Tensor
    m2: Tensor
    running_return: Tensor

    def __init__(
        self,
        gamma: float = 0.99,
        *,
        reward_key: NestedKey = "reward",
        reset: ResetRule = "never",
        clip: float | None = 10.0,
        eps: float = 1e-8,
        time_dim: int = -1,
        done_key: NestedKey = "done",
    ) -> None:
        if not 0 <= gamma <= 1:
            raise UserError(f"gamma={gamma} is outside [0, 1]: give a discount such as 0.99.")
        if reset not in get_args(ResetRule):
            raise UserError(f"reset={reset!r} is unknown: choose never or done.")
        if clip is not None and not clip > 0:
            raise UserError(f"clip={clip} is not positive: give a bound such as 10.0, or None.")
        if not (eps >= 0 and math.isfinite(eps)):
            raise UserError(f"eps={eps} is negative or not finite: give a value such as 1e-8.")
        super().__init__(reward_key)
        self.done_key = unravel_key(done_key)
        self.gamma = gamma
        self.reset_rule: ResetRule = reset
        self.clip = clip
        self.eps = eps
        self.time_dim = time_dim
        self.frozen = False
        self.register_buffer("count", torch.tensor(INITIAL_COUNT, dtype=torch.float64))
        self.register_buffer("mean", torch.tensor(0.0, dtype=torch.float64))
        self.register_buffer("m2", torch.tensor(INITIAL_COUNT, dtype=torch.float64))
        # One entry for each environment, from the first reward on.
        self.register_buffer("running_return", torch.zeros(0, dtype=torch.float64))

    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Scales a batch step by step along ``time_dim``; returns a shallow copy."""
        batch, next_td = copied(tensordict)
        time_dim = self.time_dim % batch.ndim if batch.ndim else None
        learn = self.training and not self.frozen
        if learn and split_mask(batch) is not None:
            raise UserError(
                "the batch holds split trajectories, padded and not side by side in time: collect "
                "with split_trajs=False, or call .freeze() to scale without learning."
            )
        self._scale(next_td, self._read(next_td), time_dim, learn)
        return batch

    @torch.no_grad()
    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        reward = self._read_step(next_tensordict)
        return self._scale(next_tensordict, reward, None, not self.frozen)

    def freeze(self) -> ReturnScaling:
        """Stops learning. Rewards are divided by the present standard deviation."""
        self.frozen = True
        return self

    def unfreeze(self) -> ReturnScaling:
        """Resumes learning."""
        self.frozen = False
        return self

    def _scale(
        self, next_td: TensorDictBase, reward: Tensor, time_dim: int | None, learn: bool
    ) -> TensorDictBase:
        steps = _as_steps(reward, time_dim, self.mean)
        if learn:
            done = None
            if self.reset_rule == "done":
                flag = next_td.get(self.done_key)
                while flag.ndim < reward.ndim:
                    flag = flag.unsqueeze(-1)
                done = _as_steps(flag.expand_as(reward), time_dim, self.mean).bool()
            values = reward.shape[next_td.ndim :].numel()
            std = self._learn(steps, done, values)
        elif self.running_return.numel() == 0:
            raise UserError(
                "ReturnScaling has learned nothing yet and is in eval mode (TorchRL's "
                "Compose.append and replay buffers do that) or frozen: call .train() and "
                ".unfreeze(), or load its state."
            )
        else:
            std = (self.m2 / self.count + self.eps).sqrt()
        scaled = steps / std
        if self.clip is not None:
            scaled = scaled.clamp(-self.clip, self.clip)
        return next_td.set(self.reward_key, _from_steps(scaled, reward, time_dim))

    def _learn(self, steps: Tensor, done: Tensor | None, values: int) -> Tensor:
        envs, before = steps.shape[0], self.running_return
        first = before.numel() == 0
        if first:
            before = before.new_zeros(envs)
        if before.shape[0] != envs:
            raise UserError(
                f"the running returns are those of {before.shape[0]} environments "
                f"and the batch has {envs}: give whole batches with time along "
                f"time_dim={self.time_dim}, or call .freeze() to scale without learning."
            )
        returns, carry = discounted_filter(steps, done, before, self.gamma)
        count, mean, m2 = running_moments(returns, self.count, self.mean, self.m2)
        if steps.shape[1]:
            new = [carry, count[-1], mean[-1], m2[-1]]
            if torch.compiler.is_compiling():  # A graph cannot raise.
                old, learn = [before, self.count, self.mean, self.m2], m2[-1].isfinite()
                new = [torch.where(learn, x, y) for x, y in zip(new, old, strict=True)]
            elif not _finite(m2[-1]):
                raise NonFiniteReward(_place(steps, values))
            # Replaced, not filled in place, which torch.compile (2.13) would lose.
            self.running_return, self.count, self.mean, self.m2 = (x.clone() for x in new)
        elif first:
            self.running_return = before
        return (m2 / count + self.eps).sqrt()

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        if self.reset_rule == "done" and not self.frozen and self.running_return.numel():
            root = tensordict.get("_reset", None)
            mask = tensordict.get(_reset_key(self.done_key), root)
            if mask is None:
                self.running_return.zero_()
            else:
                shape = self.parent.full_reward_spec[self.reward_key].shape
                while mask.ndim < len(shape):
                    mask = mask.unsqueeze(-1)
                mask = mask.expand(shape).reshape(-1).to(self.running_return.device)
                self.running_return.masked_fill_(mask, 0.0)
        return tensordict_reset

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        """The scaled reward is bounded by ``clip``."""
        super().transform_reward_spec(reward_spec)
        spec = unbounded(reward_spec[self.reward_key])
        if self.clip is not None:
            kind: dict[str, Any] = {"dtype": spec.dtype, "device": spec.device}
            spec = Bounded(-self.clip, self.clip, shape=spec.shape, **kind)
        reward_spec[self.reward_key] = spec
        return reward_spec

    def _load_from_state_dict(
        self, state_dict: Mapping[str, Any], prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        saved = state_dict.get(f"{prefix}running_return")
        if saved is not None:
            self.running_return = self.running_return.new_zeros(saved.shape)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)


def _as_steps(value: Tensor, time_dim: int | None, like: Tensor) -> Tensor:
    """A reward as ``(M, T)``: environments and event dimensions by time."""
    value = value.to(like)
    if time_dim is None:
        return value.reshape(-1, 1)
    value = value.movedim(time_dim, -1)
    return value.reshape(-1, value.shape[-1])


def _from_steps(steps: Tensor, like: Tensor, time_dim: int | None) -> Tensor:
    """The inverse of :func:`_as_steps`, in the shape, dtype and device of ``like``."""
    if time_dim is not None:
        steps = steps.reshape(like.movedim(time_dim, -1).shape).movedim(-1, time_dim)
    return steps.reshape(like.shape).to(like)


def _finite(value: Tensor) -> bool:
    """Waits for the device, once a batch."""
    return bool(value.isfinite())


def _place(steps: Tensor, values: int) -> str:
    """Describes the earliest reward that is not finite; an environment has ``values`` of them."""
    bad = ~steps.isfinite()
    if not bad.any():
        return f"a reward of {steps.abs().max().item():g} is too large to be squared"
    time = int(bad.any(0).nonzero()[0])
    rows = bad[:, time].nonzero()
    value = steps[rows[0], time].item()
    every = len(rows) == len(steps) > values
    where = "every environment" if every else f"environment {int(rows[0]) // values}"
    step = f"at step {time} of the batch" if steps.shape[1] > 1 else "at this step"
    return f"the reward is {value} in {where} {step}"


def _reset_key(done_key: NestedKey) -> NestedKey:
    return "_reset" if isinstance(done_key, str) else (*done_key[:-1], "_reset")
