"""Training a reward model beside the policy, a few steps with each of its batches."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import Transform

from giril_rl.graphs.gradients import TracedGradients
from giril_rl.rewards.adversarial import AdversarialLoss, DiscriminatorConfig
from giril_rl.rewards.transitions import TERMINATED
from giril_rl.runs.randomness import restore_rng, rng_state, seeded, stream_seed
from giril_rl.transforms.absorbing import AbsorbingReward


class RewardTrainer(Protocol):
    """Trains a reward model on each batch that the policy collects, before it is relabelled.

    Examples:
        >>> class Count:
        ...     batches = 0
        ...     def update(self, batch):
        ...         self.batches += 1
        ...         return {"reward_model/batches": float(self.batches)}
        ...     def state_dict(self):
        ...         return {"batches": self.batches}
        ...     def load_state_dict(self, state):
        ...         self.batches = state["batches"]
        >>> trainer: RewardTrainer = Count()
    """

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Learns from a batch ``(num_envs, time)`` and returns what is to be logged.

        It reads observation, action and next observation, never a reward, and writes nothing.
        """
        ...

    def state_dict(self) -> dict[str, Any]:
        """All that later updates depend on, of the kinds that a checkpoint can hold."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` gave."""
        ...


Source = Callable[[int], TensorDictBase | None]
"""``source(count)`` draws ``count`` of the policy's transitions, flat; None where there are none
yet."""


class AdversarialTrainer:
    """Trains the discriminator of GAIL, VAIL and AIRL.

    On-policy, each batch that was collected gets ``cfg.updates`` gradient steps on pairs drawn from
    it. Off-policy (``source``), the policy's pairs are drawn from all that it did, as
    Discriminator-Actor-Critic does (Kostrikov et al. 2019, arXiv 1809.02925), and ``cfg.updates``
    gradient steps go to each ``cfg.every`` environment steps, whatever a batch's size. The first
    batch, before which nothing is stored, is drawn from itself.

    Args:
        loss: the discriminator's loss; its reward module is trained in place.
        expert: the expert's transitions, a flat batch with the loss's ``transition_keys``.
        cfg: step size, gradient steps with each batch, and minibatch size.
        seed: seeds minibatches and the loss's noise; the global random state is left alone.
        source: draws from the off-policy learner's own transitions, as
            :meth:`~giril_rl.training.sac.SAC.own` does; not from the demonstration's, which a
            learner may keep besides. None trains on-policy.
        log_prob: ``log_prob(observation, action)``, the present policy's log-probabilities, for a
            loss that reads them, such as AIRL's.
        terminal_rate: failures for each demonstrated transition, see :func:`terminal_rate`; where
            the reward judges absorbing states, it counts rather than the flags of ``expert``, which
            may be a sample without its ends.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from giril_rl.rewards import AdversarialConfig, DiscriminatorLoss, DiscriminatorReward
        >>> reward = DiscriminatorReward.for_vectors(
        ...     2, Bounded(-1, 1, shape=(1,)), normalise="raw"
        ... )
        >>> pairs = lambda *n: TensorDict(
        ...     {"observation": torch.randn(*n, 2), "action": torch.zeros(*n, 1)}, n
        ... )
        >>> trainer = AdversarialTrainer(
        ...     DiscriminatorLoss(reward), pairs(50), AdversarialConfig(), seed=0
        ... )
        >>> metrics = trainer.update(pairs(4, 100))  # 4 environments, 100 steps
        >>> sorted(metrics)[:2]
        ['discriminator/accuracy_expert', 'discriminator/accuracy_policy']
    """

    def __init__(
        self,
        loss: AdversarialLoss,
        expert: TensorDictBase,
        cfg: DiscriminatorConfig,
        *,
        seed: int,
        source: Source | None = None,
        log_prob: Callable[[Tensor, Tensor], Tensor] | None = None,
        terminal_rate: float = 0.0,
    ) -> None:
        self.loss = loss
        self.cfg = cfg
        self.source = source
        self._log_prob = log_prob
        self._keys: list[NestedKey] = loss.transition_keys
        self.gradients = TracedGradients(
            loss, keys=loss.in_keys, log=loss.log_keys, compile=cfg.compile
        )
        device = self.gradients.parameters[0].device
        loss.to(device)  # VAIL's beta as well, which is the loss's and not the reward's.
        self._device = device
        self._expert = [column.contiguous() for column in self._columns(expert)]
        if loss.reward.absorbing is not None:
            place = self._keys.index(TERMINATED)
            self._expert[place] = torch.full((len(self._expert[0]), 1), terminal_rate).to(device)
        self.optimizer = torch.optim.Adam(self.gradients.parameters, lr=cfg.lr, fused=True)
        self._taken = 0
        with seeded(stream_seed("reward", seed), device):
            self._rng = rng_state(device)

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Trains the discriminator with a batch ``(num_envs, time)``; reads no reward of it.

        Returns:
            Means over the steps of all losses and of what the loss logs, and its state. Off-policy,
            a batch may be too small for a step: then the state alone.
        """
        policy = self._columns(batch)
        self.loss.reward.observe(policy[0])
        steps = self._due(len(policy[0]))
        with seeded(0, self._device):
            restore_rng(self._rng)
            drawn = self._from_source(steps)
            logs = [self._step(policy if part is None else part) for part in drawn]
            self._rng = rng_state(self._device)
        metrics = {
            f"discriminator/{name}": torch.stack([log[name] for log in logs]).mean().item()
            for name in (logs[0] if logs else ())
        }
        for name, value in self.loss.logged_state().items():
            metrics[f"discriminator/{name}"] = value
        return metrics

    def _due(self, transitions: int) -> int:
        """Gradient steps that follow ``transitions`` more environment steps."""
        if self.source is None:
            return self.cfg.updates
        before = self._taken * self.cfg.updates // self.cfg.every
        self._taken += transitions
        return self._taken * self.cfg.updates // self.cfg.every - before

    def _from_source(self, steps: int) -> Sequence[list[Tensor] | None]:
        """The policy's part of ``steps`` minibatches; None for what the collected batch gives."""
        size, drawn = self.cfg.batch, None
        if self.source is not None and steps:
            drawn = self.source(steps * size)
        if drawn is None:
            return [None] * steps
        columns = [column.split(size) for column in self._columns(drawn)]
        return [list(part) for part in zip(*columns, strict=True)]

    def _step(self, policy: list[Tensor]) -> dict[str, Tensor]:
        sides = [_drawn(columns, self.cfg.batch) for columns in (self._expert, policy)]
        log = self.gradients.step([x for side in sides for x in self._with_log_prob(side)])
        self.optimizer.step()
        self.loss.after_step(log)
        return log

    def _columns(self, transitions: TensorDictBase) -> list[Tensor]:
        """What the loss reads of transitions, flat and on its device."""
        dims = transitions.ndim
        columns = [transitions.get(key) for key in self._keys]
        if dims != 1:
            columns = [column.flatten(0, dims - 1) for column in columns]
        return [column.to(self._device) for column in columns]

    @torch.no_grad()
    def _with_log_prob(self, columns: list[Tensor]) -> list[Tensor]:
        if self._log_prob is None:
            return columns
        return [*columns, self._log_prob(columns[0], columns[1])]

    def state_dict(self) -> dict[str, Any]:
        """All that later updates depend on, the reward module included."""
        return {
            "loss": dict(self.loss.state_dict()),
            "optimizer": self.optimizer.state_dict(),
            "rng": self._rng,
            "taken": self._taken,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` gave."""
        self.loss.load_state_dict(state["loss"])
        self.optimizer.load_state_dict(state["optimizer"])
        self._rng = state["rng"]
        self._taken = state["taken"]


def absorbing_value(reward: Any, gamma: float, weight: float = 1.0) -> list[Transform]:
    """What a failure leads to, where the reward judges absorbing states: a transform, or none.

    Args:
        reward: a discriminator's reward.
        gamma: the learner's discount.
        weight: the reward's factor, where it is a term of a sum.

    Examples:
        >>> from torchrl.data import Categorical
        >>> from giril_rl.rewards import DiscriminatorReward
        >>> absorbing_value(DiscriminatorReward.for_vectors(2, Categorical(3)), gamma=0.99)
        []
    """
    if reward.absorbing is None:
        return []
    return [AbsorbingReward(lambda: weight * reward.absorbing_reward(), gamma)]


def terminal_rate(transitions: TensorDictBase) -> float:
    """Failures for each transition of a demonstration: what a discriminator's expert set lacks.

    DAC adds an absorbing pair for each demonstrated failure before it leaves transitions out, and
    weighs it so that its share stays. Give the whole demonstration, before any is left out.

    Args:
        transitions: batch ``(n,)`` with ``("next", "terminated")``; a time limit is no failure.

    Examples:
        >>> from tensordict import TensorDict
        >>> ends = torch.tensor([[False], [False], [False], [True]])
        >>> terminal_rate(TensorDict({"next": {"terminated": ends}}, [4]))
        0.25
    """
    return transitions.get(TERMINATED).double().mean().item()


def _drawn(columns: list[Tensor], size: int) -> list[Tensor]:
    """``size`` rows without repetition, or all of them where there are no more."""
    rows = len(columns[0])
    if rows <= size:
        return columns
    index = torch.randperm(rows)[:size].to(columns[0].device)
    return [column[index] for column in columns]
