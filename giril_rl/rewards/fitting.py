"""Losses that train a reward on a demonstration, and fitting one in a single call."""

from __future__ import annotations

import math
from abc import abstractmethod
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any, Literal, cast, get_args

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictParams, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import LossModule

from giril_rl.errors import UserError
from giril_rl.rewards.scaler import check_finite
from giril_rl.rewards.transitions import check_transitions, read, reads_actions, with_action
from giril_rl.runs.randomness import seeded

Reduction = Literal["mean", "sum", "none"]


class RewardLoss(LossModule):
    """A loss that trains a reward module; its arguments are those of :class:`TransitionLoss`."""

    reward: TensorDictModuleBase
    reward_params: TensorDictParams
    target_reward_params: TensorDictParams

    def __init__(self, reward: TensorDictModuleBase, *, functional: bool = False) -> None:
        super().__init__()
        if functional:
            self.convert_to_functional(cast(Any, reward), "reward")
        else:
            self.reward = reward
        self._functional = functional

    @property
    def functional(self) -> bool:
        """Whether the parameters are kept apart from the module, under ``reward_params``."""
        return self._functional

    def parameters_in_reward(self) -> AbstractContextManager[Any]:
        """Inside, the reward computes with the loss's ``reward_params``, if it has any."""
        return self.reward_params.to_module(self.reward) if self.functional else nullcontext()


class TransitionLoss(RewardLoss):
    """A loss of single transitions, in one or more terms, whose sum is to be minimised.

    A subclass names its terms in ``out_keys`` and computes them in :meth:`terms`, one number per
    transition each.

    Args:
        reward: the module to train, which reads observation and action, and the next observation
            or not; its parameters are this loss's parameters.
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` over transitions.
        functional: keep parameters and buffers apart from the module, under ``reward_params``, as
            TorchRL's own losses do. By default they stay in the module: the loss's ``state_dict``
            then has the module's names, and its noise generator's state.

    Raises:
        UserError: for an unknown reduction, or missing entries.

    Examples:
        >>> from torchrl.data import Bounded
        >>> from giril_rl.rewards import GenerativeReward
        >>> class KLLoss(TransitionLoss):
        ...     out_keys = ["loss_kl"]
        ...     def terms(self, observation, action, next_observation):
        ...         mu, logvar = self.reward.encode(observation, next_observation)
        ...         return (0.5 * (logvar.exp() + mu.square() - 1 - logvar).sum(-1),)
        >>> reward = GenerativeReward.for_vectors(2, Bounded(-1, 1, shape=(1,)), normalise="raw")
        >>> s, a = torch.zeros(4, 2), torch.zeros(4, 1)
        >>> batch = TensorDict({"observation": s, "action": a, "next": {"observation": s}}, [4])
        >>> KLLoss(reward, reduction="none")(batch)["loss_kl"].shape
        torch.Size([4])
    """

    @dataclass
    class _AcceptedKeys:
        """The keys that :meth:`set_keys` changes; their defaults are the reward's ``in_keys``."""

        observation: NestedKey = "observation"
        action: NestedKey = "action"
        next_observation: NestedKey = ("next", "observation")

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys

    def __init__(
        self,
        reward: TensorDictModuleBase,
        *,
        reduction: Reduction = "mean",
        functional: bool = False,
    ) -> None:
        if reduction not in get_args(Reduction):
            raise UserError(f"reduction={reduction!r} is unknown: choose mean, sum or none.")
        super().__init__(reward, functional=functional)
        self.reduction = reduction
        entries = ["observation", "action", "next_observation"]
        if not reads_actions(reward):
            entries.remove("action")
        self._entries = entries[: len(reward.in_keys)]
        self.set_keys(**dict(zip(self._entries, reward.in_keys, strict=True)))

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys of what the reward reads of observation, action and next observation."""
        return [getattr(self.tensor_keys, entry) for entry in self._entries]

    @property
    @abstractmethod
    def out_keys(self) -> list[NestedKey]:
        """Names of the terms, ``loss_*``."""

    @abstractmethod
    def terms(self, *args: Any, **kwargs: Any) -> tuple[Tensor, ...]:
        """The terms in the order of their names, each of the batch's shape.

        A subclass takes what the reward reads: ``observation`` ``(*batch, d)``, as the environment
        gives it, ``action``, as the environment takes it (empty with ``use_actions=False``), and
        perhaps ``next_observation``.
        """

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The terms, reduced; with ``reduction="none"`` of the batch's shape."""
        with self.parameters_in_reward():
            terms = self.terms(*with_action(self.reward, read(tensordict, self.in_keys)))
        reduced = {
            name: self._reduce_loss(term, tensordict=tensordict)
            for name, term in zip(self.out_keys, terms, strict=True)
        }
        batch_size = tensordict.batch_size if self.reduction == "none" else []
        return TensorDict._new_unsafe(reduced, torch.Size(batch_size))


def fit(
    loss: TransitionLoss,
    demonstration: TensorDictBase,
    *,
    steps: int = 50_000,
    batch: int = 32,
    lr: float = 3e-5,
    seed: int = 0,
) -> dict[str, float]:
    """Fits the reward's scaler, then minimises its loss by Adam; the defaults are the paper's.

    This is for other projects. The recipes do the same with checkpoints and logs.

    Args:
        loss: the reward's loss; its module is trained in place and left in eval mode.
        demonstration: transitions of any leading shape, with the loss's ``in_keys``; a copy goes to
            the loss's device.
        steps: gradient steps.
        batch: minibatch size, drawn with replacement.
        lr: Adam's step size.
        seed: seeds minibatches and the loss's noise. The global random state is left as it was.

    Returns:
        The loss's terms at the last step.

    Raises:
        UserError: for a loss that needs the policy's transitions as well, no transitions or steps,
            entries that are missing, NaN, infinite or of a wrong shape, actions outside the action
            spec, or a loss that is no longer finite at the end.

    Examples:
        >>> from torchrl.data import Bounded
        >>> from giril_rl.rewards import GenerativeReward, GenerativeRewardLoss
        >>> s, a = torch.randn(50, 2), torch.rand(50, 1)
        >>> demo = TensorDict({"observation": s, "action": a, "next": {"observation": s + a}}, [50])
        >>> reward = GenerativeReward.for_vectors(2, Bounded(-1, 1, shape=(1,)))
        >>> sorted(fit(GenerativeRewardLoss(reward), demo, steps=3))
        ['loss_action', 'loss_kl', 'loss_reconstruction']
    """
    if not isinstance(loss, TransitionLoss):
        raise UserError(
            f"{type(loss).__name__} needs the policy's transitions as well: train it beside the "
            "policy, not before."
        )
    count = demonstration.batch_size.numel()
    if count < 1 or steps < 1 or batch < 1:
        raise UserError(
            f"{count} transitions, steps={steps} and batch={batch}: give at least one of each."
        )
    check_pairs(loss, demonstration)
    device = next(loss.parameters()).device
    data = demonstration.select(*loss.in_keys).reshape(-1).to(device)
    loss.reward.scaler.fit(data.get(loss.in_keys[0]))
    optimizer = torch.optim.Adam(loss.parameters(), lr=lr)
    loss.train()
    with seeded(seed, device), torch.enable_grad():
        for _ in range(steps):
            terms = loss(data[torch.randint(len(data), (batch,))])
            optimizer.zero_grad()
            torch.stack([term.sum() for term in terms.values()]).sum().backward()
            optimizer.step()
    loss.eval()
    last = {str(key): term.mean().item() for key, term in terms.items()}
    for name, value in last.items():
        if not math.isfinite(value):
            raise UserError(f"{name} is {value} after {steps} steps of lr={lr}: give a smaller lr.")
    return last


def check_pairs(loss: TransitionLoss, demonstration: TensorDictBase) -> None:
    """Checks the whole demonstration once, so that minibatches need no checks of values.

    Args:
        loss: of the reward that is to be fitted.
        demonstration: its transitions.

    Raises:
        UserError: for entries that are missing, of another shape or dtype than the reward's, or
            with values that are no action or no number.
    """
    entries = read(demonstration, loss.in_keys)
    observation, action, *_ = filled = with_action(loss.reward, entries)
    scaler, actions = loss.reward.scaler, loss.reward.actions
    batch = observation.shape[: observation.ndim - scaler.event_dims]
    if batch != demonstration.batch_size:
        raise UserError(
            f"the demonstration's batch_size is {list(demonstration.batch_size)} where its "
            f"observations have {list(batch)}: give TensorDict(..., batch_size={list(batch)})."
        )
    check_transitions(scaler, actions, *filled)
    for key, entry in zip(loss.in_keys, entries, strict=True):
        check_finite(str(key), entry)
    actions.check_values(action)
