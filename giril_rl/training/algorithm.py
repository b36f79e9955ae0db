"""What the training loop asks of a reinforcement learning algorithm."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from tensordict import TensorDictBase

from giril_rl.policies.agent import Agent


class Algorithm(Protocol):
    """Learns a policy from batches of experience, such as :class:`~giril_rl.training.ppo.PPO`.

    The loop collects, relabels, logs, checkpoints and resumes; an algorithm only acts and learns.

    Attributes:
        num_envs: parallel environments.
        frames_per_batch: transitions that are collected between two updates.
        steps: environment steps of the whole training, in whole batches.
        checkpoint_every: environment steps between checkpoints.
    """

    num_envs: int
    frames_per_batch: int
    steps: int
    checkpoint_every: int

    @property
    def agent(self) -> Agent:
        """The policy and its critics. They decide the device of learning."""
        ...

    def act(self) -> Callable[[TensorDictBase], TensorDictBase]:
        """The policy that collects, for TorchRL's collector."""
        ...

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Learns from a batch ``(num_envs, time)`` with the reward to learn from.

        Returns:
            What is to be logged.
        """
        ...

    def state_dict(self) -> dict[str, Any]:
        """All that later updates depend on, of the kinds that a checkpoint can hold."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` gave."""
        ...
