"""A fixed part of a demonstration to learn from, and the rest to test on."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from giril_rl.demos.demonstration import Demonstration
from giril_rl.errors import UserError


def subsample(demo: Demonstration, every: int, offset: int = 0) -> TensorDict:
    """Each ``every``-th transition, counted across episodes, the same ones every time.

    The paper's continuous control tasks keep one transition in 20 of 1,000 steps: 50 pairs.
    Episodes are not restarted, so that N transitions always give ``ceil((N - offset) / every)``.

    Args:
        demo: the demonstration, which is left as it is.
        every: keep 1 in this many; 1 keeps all.
        offset: index of the first one kept, below ``every``.

    Raises:
        UserError: if that is no positive number, or nothing would be left.

    Examples:
        >>> data = TensorDict({"step": torch.arange(10)}, [10])
        >>> subsample(Demonstration(data), every=4)["step"].tolist()
        [0, 4, 8]
        >>> holdout(Demonstration(data), every=4)["step"].tolist()
        [1, 2, 3, 5, 6, 7, 9]
    """
    return demo.transitions[_kept(demo, every, offset)]


def holdout(demo: Demonstration, every: int, offset: int = 0) -> TensorDict:
    """The transitions that :func:`subsample` leaves out; none for ``every=1``.

    Args:
        demo: the demonstration.
        every: as for :func:`subsample`.
        offset: as for :func:`subsample`.

    Raises:
        UserError: as :func:`subsample`.
    """
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
