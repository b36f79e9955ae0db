"""Arrays of other people's data sets: checked, named and turned into transitions."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from giril_rl.config.nearest import nearest
from giril_rl.errors import UserError
from giril_rl.files.untrusted import parse_json

NEEDED = ("observation", "action", "next_observation", "terminated", "truncated")
"""Columns with one row per transition; ``reward`` is optional."""
_FLAGS = ("terminated", "truncated")
_CALLED = {
    "obs": "observation",
    "state": "observation",
    "act": "action",
    "rew": "reward",
    "terminal": "terminated",
    "timeout": "truncated",
}
"""Words of other libraries. Not ``done``, which does not say which kind of end it is."""
_NUMBERS = "fiub"  # numpy's kinds: float, signed and unsigned integer, bool


def needed(names: Sequence[str], *, actions: bool) -> tuple[str, ...]:
    """``names``, less that of the actions where there need not be any."""
    return tuple(name for name in names if actions or name not in ("action", "actions"))


def to_transitions(columns: Mapping[str, np.ndarray], *, actions: bool = True) -> TensorDict:
    """Transitions as a demonstration stores them, not yet checked for alignment.

    Observations, continuous actions and rewards become float32, integer actions int64; images,
    uint8 [N, c, h, w], stay as they are. ``done`` is terminated or truncated. Missing ``episode``
    and ``step`` are counted from it; missing rewards become zeros.

    Args:
        columns: arrays named as in :data:`NEEDED`, and ``reward``, ``episode`` and ``step`` if
            known; flags and rewards [N] or [N, 1].
        actions: False leaves the actions out, if there are any.

    Raises:
        UserError: for a column that is missing, of another length, or not numeric.

    Examples:
        >>> zero = np.zeros((3, 2), np.float32)
        >>> end = np.array([False, True, True])
        >>> data = to_transitions({
        ...     "observation": zero, "next_observation": zero, "action": np.array([0, 1, 1]),
        ...     "terminated": end, "truncated": ~end & False,
        ... })
        >>> data["episode"].tolist(), data["step"].tolist(), data["next", "reward"].shape
        ([0, 0, 1], [0, 1, 0], torch.Size([3, 1]))
    """
    if not actions:
        columns = {name: column for name, column in columns.items() if name != "action"}
    check_names(columns, needed(NEEDED, actions=actions), "the data set has no")
    lengths = {name: len(column) if column.ndim else 0 for name, column in columns.items()}
    reference = "action" if actions else "observation"
    length = lengths[reference]
    for name, found in lengths.items():
        if found != length:
            raise UserError(
                f"the data set has {length} rows of {reference} and {found} of {name}: each needs "
                "one row per transition."
            )
    if length == 0:
        raise UserError("the data set is empty: at least 2 transitions are needed.")
    flags = {name: _flag(name, columns[name]) for name in _FLAGS}
    done = flags["terminated"] | flags["truncated"]
    reward = columns.get("reward", np.zeros(length, np.float32))
    after = {
        "observation": _observation("next_observation", columns["next_observation"]),
        "reward": torch.from_numpy(_single(_float32("reward", reward))),
        "done": torch.from_numpy(done),
        **{name: torch.from_numpy(flag) for name, flag in flags.items()},
    }
    episode, step = _counted(done.reshape(-1))
    for name, counted in (("episode", episode), ("step", step)):
        given = columns.get(name)
        if given is not None and (given.dtype != np.int64 or given.ndim != 1):
            raise UserError(f"the data set has {name} of {_described(given)}: leave it out.")
        if given is not None:
            counted[:] = given
    return TensorDict(
        {
            "observation": _observation("observation", columns["observation"]),
            **({"action": _action(columns["action"])} if actions else {}),
            "episode": torch.from_numpy(episode),
            "step": torch.from_numpy(step),
            "next": TensorDict(after, [length]),
        },
        [length],
    )


def from_episodes(episodes: Iterable[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Columns for :func:`to_transitions` from episodes with one observation more than actions.

    Args:
        episodes: each with ``observations`` [T + 1, ...], ``terminated`` and ``truncated`` [T],
            and ``actions`` [T, ...] and ``rewards`` [T] in all or none of them.

    Raises:
        UserError: naming the episode whose next states are missing or whose lengths differ.

    Examples:
        >>> no = np.zeros(2, bool)
        >>> columns = from_episodes([{"observations": np.arange(3.0)[:, None], "actions": no,
        ...                           "terminated": no, "truncated": no}])
        >>> columns["observation"].tolist(), columns["next_observation"].tolist()
        ([[0.0], [1.0]], [[1.0], [2.0]])
        >>> columns["step"].tolist()
        [0, 1]
    """
    parts: dict[str, list[np.ndarray]] = {}
    for number, episode in enumerate(episodes):
        observations = episode["observations"]
        counted = "actions" if "actions" in episode else "terminated"
        if episode[counted].ndim == 0 or observations.ndim == 0:
            raise UserError(f"episode {number} of the data set has single numbers: it needs rows.")
        length = len(episode[counted])
        if len(observations) != length + 1:
            raise UserError(
                f"episode {number} of the data set has {len(observations)} observations and "
                f"{length} {'actions' if counted == 'actions' else 'steps'}, so next states are "
                "missing or misaligned: it needs one observation more than actions, the last one "
                "after the last action."
            )
        rows = {
            "observation": observations[:-1],
            "next_observation": observations[1:],
            "terminated": episode["terminated"],
            "truncated": episode["truncated"],
            # Not counted from the flags, which are checked against these.
            "episode": np.full(length, number, np.int64),
            "step": np.arange(length, dtype=np.int64),
        }
        for theirs, ours in (("actions", "action"), ("rewards", "reward")):
            if theirs in episode:
                rows[ours] = episode[theirs]
        for name, row in rows.items():
            if row.ndim == 0 or len(row) != length:
                raise UserError(
                    f"episode {number} of the data set has {length} {counted} and "
                    f"{len(row) if row.ndim else 'no'} rows of {name}: each needs as many."
                )
            parts.setdefault(name, []).append(row)
    try:
        return {name: np.concatenate(rows) for name, rows in parts.items()}
    except (ValueError, TypeError) as error:
        raise UserError(f"the data set's episodes do not fit each other ({error}).") from None


def parse_card(text: object) -> dict[str, Any]:
    """The card of an export of ours; empty for anything else that may stand there."""
    try:
        card = parse_json(text)  # type: ignore[arg-type]
    except (ValueError, TypeError):
        card = None
    return card if isinstance(card, dict) else {}


def _described(array: np.ndarray) -> str:
    return f"{array.dtype} and shape {list(array.shape)}"


def _float32(name: str, array: np.ndarray) -> np.ndarray:
    if array.dtype.kind not in _NUMBERS:
        raise UserError(f"the data set has {name} of {_described(array)}: numbers are needed.")
    with np.errstate(over="ignore"):  # The check for infinities says where.
        return np.ascontiguousarray(array, dtype=np.float32)


def _single(array: np.ndarray) -> np.ndarray:
    """[N] or [N, 1] as [N, 1]; any other shape as it is, for the check to refuse."""
    return array[:, None] if array.ndim == 1 else array


def _flag(name: str, array: np.ndarray) -> np.ndarray:
    if array.dtype != np.bool_ or _single(array).shape != (len(array), 1):
        raise UserError(
            f"the data set has {name} of {_described(array)}: it must be bool "
            f"[{len(array)}], true where an episode ends so."
        )
    return np.ascontiguousarray(_single(array))


def _observation(name: str, array: np.ndarray) -> Tensor:
    if array.ndim > 2 and array.dtype != np.uint8:
        raise UserError(
            f"the data set has {name} of {_described(array)}: images must be uint8 [N, c, h, w], "
            "vectors [N, d]."
        )
    if array.dtype == np.uint8 and array.ndim == 4:
        return torch.from_numpy(np.array(array, order="C"))
    if array.ndim != 2:
        raise UserError(
            f"the data set has {name} of {_described(array)}: vectors must be [N, d], images uint8 "
            "[N, c, h, w]."
        )
    return torch.from_numpy(_float32(name, array))


def _action(array: np.ndarray) -> Tensor:
    if array.dtype.kind in "iu" and array[:1].size <= 1:
        if array.size and array.max() > np.iinfo(np.int64).max:
            raise UserError(f"the data set has the action {array.max()}: no task has so many.")
        return torch.from_numpy(array.reshape(-1).astype(np.int64))
    if array.dtype.kind != "f" or array.ndim != 2:
        raise UserError(
            f"the data set has action of {_described(array)}: continuous ones must be float32 or "
            "float64 [N, a], discrete ones integers [N]."
        )
    return torch.from_numpy(_float32("action", array))


def _counted(done: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Episode numbers and steps within them, both int64 [N], counted from the ends."""
    fresh = np.concatenate([[True], done[:-1]])[: len(done)]
    episode = np.cumsum(fresh) - 1
    index = np.arange(len(done))
    return episode.astype(np.int64), (index - index[fresh][episode]).astype(np.int64)


def _words(name: str) -> list[str]:
    """Our words for ``name``, singular and sorted: ``obs_next`` equals ``next_observations``."""
    words = [word if word in _CALLED else word.removesuffix("s") for word in re.split("[_.]", name)]
    return sorted(_CALLED.get(word, word) for word in words)


def meant(name: str, candidates: Iterable[str]) -> str | None:
    """Which of ``candidates`` ``name`` probably stands for.

    Examples:
        >>> ours = ["observation", "action", "next_observation", "truncated"]
        >>> [meant(name, ours) for name in ("obs", "obs_next", "timeouts", "acton", "dones")]
        ['observation', 'next_observation', 'truncated', 'action', None]
    """
    candidates = list(candidates)
    same = [candidate for candidate in candidates if _words(candidate) == _words(name)]
    return next(iter(same or nearest(name, candidates)), None)


def renamed(found: Collection[str], wanted: Iterable[str]) -> dict[str, str]:
    """Those of ``wanted`` that ``found`` has under another name, with that name."""
    wanted = list(wanted)
    missing = [name for name in wanted if name not in found]
    return {
        ours: name
        for name in found
        if name not in wanted and (ours := meant(name, missing)) is not None
    }


def check_names(found: Collection[str], needed: Sequence[str], begin: str) -> None:
    """Refuses a data set that lacks some of ``needed``, and guesses what it calls them."""
    missing = [name for name in needed if name not in found]
    if not missing:
        return
    others = renamed(found, needed)
    note = ""
    if "observation" in missing[0] and "next" in missing[0]:
        note = ", so next states are missing"
        if not others:
            note += " (or give observations with one row more than actions in each episode)"
    sentence = f"{begin} {', '.join(missing)}{note}: needed are {', '.join(needed)}"
    if others:
        pairs = " and ".join(f"{ours!r} by {name!r}" for ours, name in others.items())
        raise UserError(f"{sentence}; did you mean {pairs}?")
    if missing in (["action"], ["actions"]):
        raise UserError(f"{sentence}; --without-actions takes states alone.")
    raise UserError(f"{sentence}.")
