"""What a mistyped word was probably meant to be."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import SequenceMatcher


def _ratio(one: str, other: str) -> float:
    return SequenceMatcher(None, one, other).ratio()


def _initials(name: str) -> str:
    return "".join(word[0] for word in name.split("_") if word)


def _likeness(key: str, candidate: str) -> float:
    parent, _, last = key.rpartition(".")
    candidate_parent, _, candidate_last = candidate.rpartition(".")
    if last == candidate_last or (len(candidate_last) > 1 and _initials(last) == candidate_last):
        # The right name in the wrong part, or `learning_rate` for `lr`.
        return 0.9 + 0.1 * _ratio(parent, candidate_parent)
    if parent == candidate_parent:
        return _ratio(last, candidate_last)
    return max(_ratio(key, candidate), 0.9 * _ratio(last, candidate_last))


def nearest(key: str, candidates: Iterable[str], cutoff: float = 0.6) -> list[str]:
    """The candidates that a mistyped dotted key resembles most, at most three, ties together.

    Args:
        key: what was written.
        candidates: what could have been meant.
        cutoff: likeness in [0, 1] below which nothing is suggested.

    Examples:
        >>> nearest("ppo.learning_rate", ["ppo.lr", "fit.lr", "ppo.clip"])
        ['ppo.lr']
        >>> nearest("lr", ["ppo.lr", "fit.lr", "ppo.clip"])
        ['fit.lr', 'ppo.lr']
    """
    scores = {candidate: round(_likeness(key, candidate), 3) for candidate in candidates}
    best = max(scores.values(), default=0.0)
    if best < cutoff:
        return []
    return sorted(candidate for candidate, score in scores.items() if score == best)[:3]


def did_you_mean(key: str, candidates: Iterable[str]) -> str:
    """The suggestion as the end of a sentence, empty where nothing is near.

    Examples:
        >>> did_you_mean("girl", ["giril", "expert"])
        "; did you mean 'giril'?"
    """
    found = nearest(key, candidates)
    return f"; did you mean {' or '.join(repr(name) for name in found)}?" if found else ""
