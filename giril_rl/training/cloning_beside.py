"""Behaviour cloning beside reinforcement learning: gradient steps on the learner's own actor."""

from __future__ import annotations

from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from giril_rl.rewards.dril import DisagreementConfig
from giril_rl.runs.randomness import stream_seed


class Imitator(Protocol):
    """An agent that can be cloned beside its algorithm's own learning."""

    @property
    def actor(self) -> nn.Module:
        """What is trained."""
        ...

    def imitation_loss(self, observation: Tensor, action: Tensor) -> Tensor:
        """The loss of each demonstrated pair, ``(*batch,)``, differentiable in the actor."""
        ...


class CloningTrainer:
    """Takes gradient steps of behaviour cloning with each batch that the policy collects (DRIL).

    A :class:`~giril_rl.training.RewardTrainer` that trains no reward: it reads only how many
    environment steps were taken.

    Args:
        agent: its actor is trained in place, by an optimizer of its own.
        pairs: the demonstration's observations (raw) and actions (as executed), ``(n,)``.
        every: environment steps for each gradient step; what is left over counts for the next
            batch.
        batch: pairs per gradient step, drawn with replacement.
        lr: Adam's step size.
        seed: seeds the minibatches; the global random state is left alone.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Categorical
        >>> from giril_rl.policies import ActorCritic
        >>> s, a = torch.randn(50, 4), torch.ones(50, dtype=torch.int64)
        >>> pairs = TensorDict({"observation": s, "action": a}, [50])
        >>> trainer = CloningTrainer(ActorCritic(4, Categorical(2)), pairs, every=100, seed=0)
        >>> trainer.update(pairs), list(trainer.update(pairs))  # 50 steps, and 50 more
        ({}, ['bc/loss'])
    """

    def __init__(
        self,
        agent: Imitator,
        pairs: TensorDictBase,
        *,
        every: int,
        batch: int = 100,
        lr: float = 2.5e-4,
        seed: int,
    ) -> None:
        self.agent, self.every, self.batch = agent, every, batch
        parameters = list(agent.actor.parameters())
        device = parameters[0].device
        self._pairs = [pairs.get(key).to(device) for key in ("observation", "action")]
        self.optimizer = torch.optim.Adam(parameters, lr=lr, fused=True)
        self._generator = torch.Generator().manual_seed(stream_seed("training", seed))
        self._taken = 0

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Takes the gradient steps that are due after a batch; reads nothing of it.

        Returns:
            Their mean loss; nothing where none was due.
        """
        before = self._taken // self.every
        self._taken += batch.numel()
        losses = [self._step() for _ in range(self._taken // self.every - before)]
        return {"bc/loss": torch.stack(losses).mean().item()} if losses else {}

    def _step(self) -> Tensor:
        index = torch.randint(len(self._pairs[0]), (self.batch,), generator=self._generator)
        with torch.enable_grad():
            loss = self.agent.imitation_loss(*(x[index.to(x.device)] for x in self._pairs)).mean()
            self.optimizer.zero_grad()
            loss.backward()
        self.optimizer.step()
        return loss.detach()

    def state_dict(self) -> dict[str, Any]:
        """Optimizer, minibatches' random state and steps; the actor is in its algorithm's state."""
        return {
            "optimizer": self.optimizer.state_dict(),
            "generator": self._generator.get_state(),
            "taken": self._taken,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` gave."""
        self.optimizer.load_state_dict(state["optimizer"])
        self._generator.set_state(state["generator"])
        self._taken = state["taken"]


def make_cloning(
    agent: Imitator, pairs: TensorDictBase, settings: DisagreementConfig, *, seed: int
) -> CloningTrainer | None:
    """DRIL's cloning beside, as its settings have it; None where they leave it out.

    Args:
        agent: see :class:`CloningTrainer`.
        pairs: see there.
        settings: DRIL's, of which ``bc_every``, ``bc_batch`` and ``bc_lr`` are read.
        seed: see there.
    """
    if settings.bc_every is None:
        return None
    return CloningTrainer(
        agent,
        pairs,
        every=settings.bc_every,
        batch=settings.bc_batch,
        lr=settings.bc_lr,
        seed=seed,
    )
