"""What trains a reward model beside the policy."""

from __future__ import annotations

from typing import Any, Protocol

from tensordict import TensorDictBase


class RewardLearner(Protocol):
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
        >>> learner: RewardLearner = Count()
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
