"""``result.json``, whose every value that is used anywhere is looked at where it is read."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from giril_rl.errors import UserError
from giril_rl.files.disk import read_json

Check = Callable[[Any], bool]


def _word(value: Any) -> bool:
    return isinstance(value, str) and value != "" and value.isprintable()


def _natural(value: Any) -> bool:
    return type(value) is int and 0 <= value < 2**63


def _number(value: Any) -> bool:
    return _natural(abs(value)) if type(value) is int else _real(value)


def _real(value: Any) -> bool:
    return isinstance(value, float) and math.isfinite(value)


def _or_none(check: Check) -> Check:
    return lambda value: value is None or check(value)


def _flag(value: Any) -> bool:
    return isinstance(value, bool)


def _mapping(value: Any) -> bool:
    return isinstance(value, dict)


SCORES: dict[str, Check] = {
    "return_mean": _number,
    "return_std": _number,
    "return_median": _number,
    "episode_length_mean": _number,
}
NEEDED: dict[str, Check] = {
    "method": _word,
    "task": _word,
    "seed": _natural,
    "env_steps": _natural,
    "episodes": _natural,
    **SCORES,
    "config_hash": _word,
}
"""What every ``result.json`` has."""
OPTIONAL: dict[str, Check] = {
    "profile": _or_none(_word),
    "seeds": _mapping,
    "deterministic": _or_none(_mapping),
    "life_length_mean": _or_none(_number),
    "wall_seconds": _or_none(_number),
    "fit_seconds": _or_none(_number),
    "inexact_resumes": _natural,
    "steps_per_second": _or_none(_number),
    "expert_return_mean": _or_none(_number),
    "demo_return_mean": _or_none(_number),
    "demo": _or_none(_word),
    "demo_id": _or_none(_word),
    "demo_transitions": _or_none(_natural),
    "processor": _or_none(_word),
    "held_action": _natural,
    "random_policy": _flag,
    "versions": _mapping,
}
"""What runs of some kind, or of an earlier version, have not."""


def read_result_file(path: Path) -> dict[str, Any]:
    """What a run wrote into ``path``.

    Raises:
        UserError: if it cannot be read, or has an entry that no run writes, naming it.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "result.json"
        >>> _ = path.write_text('{"method": "giril", "task": "hopper", "seed": -1}')
        >>> read_result_file(path)  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: ...result.json has no seed as a run writes it: ...
    """
    result = read_json(path)
    wrong = _first_wrong(result)
    if wrong is not None:
        raise UserError(
            f"{path} has no {wrong} as a run writes it: restore a copy, or make the run anew."
        )
    return result


def _first_wrong(result: dict[str, Any]) -> str | None:
    for key, check in NEEDED.items():
        if not check(result.get(key)):
            return key
    for key, check in OPTIONAL.items():
        if key in result and not check(result[key]):
            return key
    for key, seed in result.get("seeds", {}).items():
        if not _or_none(_natural)(seed):
            return f"seeds.{key}" if _word(key) else "seeds"
    for key, text in result.get("versions", {}).items():
        if not _or_none(_word)(text):
            return f"versions.{key}" if _word(key) else "versions"
    mode = result.get("deterministic")
    for key, check in SCORES.items():
        if mode is not None and not check(mode.get(key)):
            return f"deterministic.{key}"
    return None
