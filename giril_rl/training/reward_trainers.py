"""Training a reward model beside the policy, a few steps with each of its batches."""

from __future__ import annotations

from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor

from giril_rl.graphs.gradients import TracedGradients
from giril_rl.rewards.discriminator import AdversarialConfig, DiscriminatorLoss
from giril_rl.runs.randomness import restore_rng, rng_state, seeded, stream_seed


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


class AdversarialTrainer:
    """Trains the discriminator of GAIL and VAIL.

    Args:
        loss: the discriminator's loss; its reward module is trained in place.
        expert: the expert's pairs, a flat batch with the reward's ``in_keys``.
        cfg: step size, gradient steps with each batch, and minibatch size.
        seed: seeds minibatches and the loss's noise; the global random state is left alone.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from giril_rl.rewards import DiscriminatorReward
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
        self, loss: DiscriminatorLoss, expert: TensorDictBase, cfg: AdversarialConfig, *, seed: int
    ) -> None:
        self.loss = loss
        self.cfg = cfg
        self._pair_keys = loss.reward.in_keys
        self.gradients = TracedGradients(
            loss, keys=loss.in_keys, log=loss.log_keys, compile=cfg.compile
        )
        device = self.gradients.parameters[0].device
        loss.to(device)  # VAIL's beta as well, which is the loss's and not the reward's.
        self._expert = [expert.get(key).contiguous().to(device) for key in self._pair_keys]
        self.optimizer = torch.optim.Adam(self.gradients.parameters, lr=cfg.lr, fused=True)
        self._device = device
        with seeded(stream_seed("reward", seed), device):
            self._rng = rng_state(device)

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Trains the discriminator on a batch ``(num_envs, time)`` of which it reads the pairs.

        Returns:
            Means over the steps of all losses and of what the loss logs, and its state.
        """
        dims = batch.ndim
        policy = [batch.get(key).flatten(0, dims - 1) for key in self._pair_keys]
        self.loss.reward.observe(policy[0])
        with seeded(0, self._device):
            restore_rng(self._rng)
            logs = [self._step(policy) for _ in range(self.cfg.updates)]
            self._rng = rng_state(self._device)
        metrics = {
            f"discriminator/{name}": torch.stack([log[name] for log in logs]).mean().item()
            for name in logs[0]
        }
        for name, value in self.loss.logged_state().items():
            metrics[f"discriminator/{name}"] = value
        return metrics

    def _step(self, policy: list[Tensor]) -> dict[str, Tensor]:
        log = self.gradients.step(
            [*_drawn(self._expert, self.cfg.batch), *_drawn(policy, self.cfg.batch)]
        )
        self.optimizer.step()
        self.loss.after_step(log)
        return log

    def state_dict(self) -> dict[str, Any]:
        """All that later updates depend on, the reward module included."""
        return {
            "loss": dict(self.loss.state_dict()),
            "optimizer": self.optimizer.state_dict(),
            "rng": self._rng,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` gave."""
        self.loss.load_state_dict(state["loss"])
        self.optimizer.load_state_dict(state["optimizer"])
        self._rng = state["rng"]


def _drawn(columns: list[Tensor], size: int) -> list[Tensor]:
    """``size`` rows without repetition, or all of them where there are no more."""
    rows = len(columns[0])
    if rows <= size:
        return columns
    index = torch.randperm(rows)[:size].to(columns[0].device)
    return [column[index] for column in columns]
