"""Suggestions for mistyped names."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches


def nearest(key: str, candidates: Iterable[str]) -> list[str]:
    """The names that a mistyped, possibly dotted one most resembles, at most three.

    :mod:`difflib` compares the parts before and after the last dot one at a time, so that the right
    name in the wrong part is found. It cannot know that ``learning_rate`` means ``lr``: initials
    count as an exact match.

    Args:
        key: what was written.
        candidates: what could have been meant.

    Examples:
        >>> nearest("ppo.learning_rate", ["ppo.lr", "fit.lr", "ppo.clip"])
        ['ppo.lr']
        >>> nearest("lr", ["ppo.lr", "fit.lr", "ppo.clip"])
        ['fit.lr', 'ppo.lr']
    """
    parent, _, name = key.rpartition(".")
    everywhere = [candidate.rpartition(".") for candidate in candidates]
    close = get_close_matches(parent, sorted({part for part, _, _ in everywhere}), n=1)
    here = [found for found in everywhere if found[0] in close]
    initials = "".join(word[:1] for word in name.split("_"))
    exact = {name, initials} if len(initials) > 1 else {name}
    for group in (here, everywhere):
        if same := [found for found in group if found[2] in exact]:
            return sorted("".join(found) for found in same)[:3]
    for group in (here, everywhere):
        if similar := get_close_matches(name, sorted({found[2] for found in group}), n=1):
            return sorted("".join(found) for found in group if found[2] in similar)[:3]
    return []


def did_you_mean(key: str, candidates: Iterable[str]) -> str:
    """The suggestion as the end of a sentence, empty where nothing is near.

    Examples:
        >>> did_you_mean("girl", ["giril", "expert"])
        "; did you mean 'giril'?"
    """
    found = nearest(key, candidates)
    return f"; did you mean {' or '.join(repr(name) for name in found)}?" if found else ""
