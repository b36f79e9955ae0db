"""A simulator's saved state, looked at before anything of it is played."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch


def saved_array(state: dict[str, Any], name: str, like: np.ndarray) -> np.ndarray:
    """A copy of an entry of :meth:`BatchedEnv.simulator_state`, of the type and shape of ``like``.

    Raises:
        ValueError: if it is another kind of thing: anyone may have written the checkpoint.

    Examples:
        >>> saved_array({"lives": torch.tensor([3])}, "lives", np.zeros(1, dtype=np.int64))
        array([3])
        >>> saved_array({"lives": torch.tensor([3.0])}, "lives", np.zeros(1, dtype=np.int64))
        Traceback (most recent call last):
        ...
        ValueError: its 'lives' is not int64 of shape [1]
    """
    found = saved_tensor(state, name)
    if found.dtype != like.dtype or found.shape != like.shape:
        raise ValueError(f"its {name!r} is not {like.dtype} of shape {list(like.shape)}")
    return found.copy()


def saved_tensor(state: dict[str, Any], name: str) -> np.ndarray:
    """An entry that has to be a tensor.

    Raises:
        ValueError: if it is something else, or not there.
    """
    found = state.get(name)
    if not isinstance(found, torch.Tensor):
        raise ValueError(f"its {name!r} is not a tensor")
    return found.numpy()


def saved_seed(state: dict[str, Any]) -> int:
    """The root of the episodes' seeds.

    Raises:
        ValueError: if it is not a natural number.
    """
    seed = state.get("seed")
    if type(seed) is not int or seed < 0:
        raise ValueError("its seed is not a natural number")
    return seed


def check_counts(name: str, counts: np.ndarray, least: int, most: int | None = None) -> None:
    """Refuses counts that no simulator can have come to.

    Raises:
        ValueError: if one is out of range.

    Examples:
        >>> check_counts("steps", np.array([0, 7]), 0, 5)
        Traceback (most recent call last):
        ...
        ValueError: its 'steps' is not between 0 and 5
    """
    if (counts < least).any() or (most is not None and (counts > most).any()):
        span = f"at least {least}" if most is None else f"between {least} and {most}"
        raise ValueError(f"its {name!r} is not {span}")


def check_game_actions(actions: np.ndarray, games: int, count: int, longest: int) -> None:
    """Refuses a history of actions that games cannot have had; ale-py waits forever for some.

    Args:
        actions: int16 ``(games, time)``, -1 after a game's last action and nowhere else.
        games: number of games.
        count: number of legal actions.
        longest: steps after which a game is cut.

    Raises:
        ValueError: if it is not that.

    Examples:
        >>> check_game_actions(np.array([[0, 3, -1]], dtype=np.int16), 1, 4, longest=5)
        >>> check_game_actions(np.array([[0, 4, -1]], dtype=np.int16), 1, 4, longest=5)
        Traceback (most recent call last):
        ...
        ValueError: its actions are not between 0 and 3, with -1 after the last
    """
    if actions.dtype != np.int16 or actions.ndim != 2 or len(actions) != games:
        raise ValueError(f"its actions are not int16 of shape [{games}, time]")
    if actions.shape[1] > longest:
        raise ValueError(f"its actions are more than the {longest:,} steps of the longest game")
    ended = actions == -1
    goes_on = ended[:, :-1] & ~ended[:, 1:]
    if (actions < -1).any() or (actions >= count).any() or goes_on.any():
        raise ValueError(f"its actions are not between 0 and {count - 1}, with -1 after the last")


def check_actions(
    actions: np.ndarray,
    shape: Sequence[int],
    bounds: tuple[np.ndarray, np.ndarray] | None,
    count: int | None,
) -> None:
    """Refuses a history of actions that simulators of vectors cannot have had.

    Args:
        actions: ``(time, *shape)``.
        shape: of one step of all simulators.
        bounds: lowest and highest of bounded real actions.
        count: number of actions, where they are integers.

    Raises:
        ValueError: if it is not that.

    Examples:
        >>> check_actions(np.array([[0, 2]]), (2,), None, 2)
        Traceback (most recent call last):
        ...
        ValueError: its actions are not ones of this task
    """
    real = count is None
    if actions.shape[1:] != tuple(shape) or actions.dtype.kind != ("f" if real else "i"):
        raise ValueError("its actions are of another shape or type than this task's")
    inside = np.isfinite(actions) if real else (actions >= 0) & (actions < count)
    if bounds is not None:
        inside &= (actions >= bounds[0]) & (actions <= bounds[1])
    if not inside.all():
        raise ValueError("its actions are not ones of this task")
