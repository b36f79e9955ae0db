"""Names of a data set's arrays: which are missing, and which were meant by others."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence

from giril_rl.config.nearest import nearest
from giril_rl.errors import UserError

_CALLED = {
    "obs": "observation",
    "state": "observation",
    "act": "action",
    "rew": "reward",
    "terminal": "terminated",
    "timeout": "truncated",
}
"""Words of other libraries. ``done`` is none: it does not say which kind of end it is."""


def _words(name: str) -> list[str]:
    """Ours, in the singular and sorted, so that ``obs_next`` and ``next_observations`` agree."""
    words = [word if word in _CALLED else word.removesuffix("s") for word in re.split("[_.]", name)]
    return sorted(_CALLED.get(word, word) for word in words)


def meant(name: str, candidates: Iterable[str]) -> str | None:
    """Which of ``candidates`` somebody probably called ``name``.

    Examples:
        >>> ours = ["observation", "action", "next_observation", "truncated"]
        >>> [meant(name, ours) for name in ("obs", "obs_next", "timeouts", "acton", "dones")]
        ['observation', 'next_observation', 'truncated', 'action', None]
    """
    candidates = list(candidates)
    same = [candidate for candidate in candidates if _words(candidate) == _words(name)]
    return next(iter(same or nearest(name, candidates)), None)


def renamed(found: Collection[str], wanted: Iterable[str]) -> dict[str, str]:
    """Those of ``wanted`` that ``found`` has under another name, and that name.

    Examples:
        >>> renamed(["obs", "action", "infos"], ["observation", "action", "reward"])
        {'observation': 'obs'}
    """
    wanted = list(wanted)
    missing = [name for name in wanted if name not in found]
    return {
        ours: name
        for name in found
        if name not in wanted and (ours := meant(name, missing)) is not None
    }


def check_names(found: Collection[str], needed: Sequence[str], begin: str) -> None:
    """Refuse a data set that lacks some of ``needed``, and say what it probably calls them.

    Args:
        found: names that it has.
        needed: names that it must have.
        begin: how the refusal begins, up to the names that are missing.

    Raises:
        UserError: naming what is missing.

    Examples:
        >>> check_names(["obs", "action"], ["observation", "action"], "mine.npz has no")
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: mine.npz has no observation: ... by 'obs'?
    """
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
    raise UserError(f"{sentence}.")
