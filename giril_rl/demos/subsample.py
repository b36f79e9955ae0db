"""Training and validation parts of a demonstration."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from giril_rl.demos.demonstration import Demonstration
from giril_rl.errors import UserError


def subsample(demo: Demonstration, every: int, offset: int = 0) -> TensorDict:
    """Each ``every``-th transition, counted across episodes: ``ceil((N - offset) / every)`` of N.

    The paper's continuous control tasks keep one transition in 20 of 1,000 steps: 50 pairs.

    Args:
        demo: the demonstration; not changed.
        every: keep 1 in this many; 1 keeps all.
        offset: index of the first one kept, below ``every``.

    Raises:
        UserError: if these are out of range, or nothing would be left.

    Examples:
        >>> data = TensorDict({"step": torch.arange(10)}, [10])
        >>> subsample(Demonstration(data), every=4)["step"].tolist()
        [0, 4, 8]
        >>> holdout(Demonstration(data), every=4)["step"].tolist()
        [1, 2, 3, 5, 6, 7, 9]
    """
    return demo.transitions[_kept(demo, every, offset)]


def holdout(demo: Demonstration, every: int, offset: int = 0) -> TensorDict:
    """The transitions that :func:`subsample` leaves out, none for ``every=1``; for validation."""
    return demo.transitions[~_kept(demo, every, offset)]


def _kept(demo: Demonstration, every: int, offset: int) -> torch.Tensor:
    if every < 1 or not 0 <= offset < every:
        raise UserError(
            f"subsample={every} with offset {offset} keeps nothing sensible: "
            "give a whole number from 1, and an offset below it."
        )
    if offset >= len(demo):
        raise UserError(
            f"subsample={every} with offset {offset} keeps none of {len(demo)} transitions: "
            "give smaller ones."
        )
    return torch.arange(len(demo)) % every == offset
