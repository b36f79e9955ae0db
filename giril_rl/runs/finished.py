"""Reads what a finished run left: its checked result, its settings, its scores as text."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import yaml

from giril_rl.config.schema import EvalConfig, TaskConfig
from giril_rl.config.validation import validate
from giril_rl.errors import UserError
from giril_rl.files.disk import read_json
from giril_rl.files.untrusted import check_format, parse_yaml, read_text

RUN_FORMAT = 2
"""The format of a run's folder, in its ``versions.json``; a folder without a number has format 1.

Format 1 has the same files, made with other random numbers: it can be read but not continued.
"""
Part = TypeVar("Part")


def check_run_format(folder: Path, readable: Collection[int] = (1, RUN_FORMAT)) -> None:
    """Refuse a run's folder of another format, by its ``versions.json``.

    Raises:
        UserError: if its format is not one of ``readable``.
    """
    path = folder / "versions.json"
    if path.is_file():
        check_format(
            read_json(path).get("format_version", 1),
            readable,
            where=f"{folder} has run format",
            older="use the version that made it, or make the run anew",
        )


def read_result(folder: Path) -> dict[str, Any]:
    """A finished run's ``result.json``, with every entry checked.

    Raises:
        UserError: if there is no finished run, one of a later format, or one with an entry that no
            run writes.
    """
    check_run_format(folder)
    path = folder / "result.json"
    if not path.exists():
        raise UserError(
            f"{folder} holds no finished run (no result.json): run it to its end first."
        )
    result = read_json(path)
    wrong = _first_wrong(result)
    if wrong is not None:
        raise UserError(
            f"{path} has no {wrong} as a run writes it: restore a copy, or make the run anew."
        )
    return result


def read_settings(folder: Path) -> tuple[TaskConfig, EvalConfig]:
    """A run's task and evaluation settings, from its ``config.yaml``.

    Raises:
        UserError: if the file is missing or no run wrote it.
    """
    config = read_config(folder)
    return (
        read_part(folder, config, "task", TaskConfig),
        read_part(folder, config, "eval", EvalConfig),
    )


def read_config(folder: Path) -> dict[str, Any]:
    """A run's nested settings, from its ``config.yaml``.

    Raises:
        UserError: if the file is missing or no run wrote it.
    """
    try:
        config = parse_yaml(read_text(folder / "config.yaml"))
    except (OSError, ValueError, yaml.YAMLError):
        raise _no_run(folder) from None
    if not isinstance(config, dict):
        raise _no_run(folder)
    return config


def read_part(folder: Path, config: dict[str, Any], name: str, kind: type[Part]) -> Part:
    """One part of :func:`read_config`'s settings as its dataclass; unknown keys are skipped.

    Raises:
        UserError: if the part is missing, or a value has the wrong type or is out of range.
    """
    names = {f.name for f in fields(kind)}  # type: ignore[arg-type]
    try:
        part = kind(**{key: value for key, value in config[name].items() if key in names})
    except (KeyError, TypeError, AttributeError):
        raise _no_run(folder) from None
    try:
        validate(part)
    except UserError as error:
        raise UserError(f"{folder / 'config.yaml'}: {name}.{error}") from None
    return part


def print_scores(folder: Path) -> None:
    """Print a finished run's scores, and those of its expert and demonstration."""
    result = read_result(folder)
    print(f"{result['method']} on {result['task']}: {result['env_steps']:,} steps, {folder}")
    for who in ("expert", "demo"):
        score = result.get(f"{who}_return_mean")
        if score is not None:
            print(f"{who:<14} return {score:,.1f}")
    print_both(result)


def print_both(scores: dict[str, Any]) -> None:
    """Print the scores of the policy as tables quote it and, if there are any, the others."""
    if scores.get("sampled") is not None:
        print(describe("deterministic", scores))
        print(describe("sampled", scores["sampled"]))
        return
    print(describe("sampled", scores))
    if scores.get("deterministic") is not None:  # Early versions have none.
        print(describe("deterministic", scores["deterministic"]))


def describe(kind: str, scores: dict[str, Any]) -> str:
    """One line of a score table.

    Examples:
        >>> describe("sampled", {
        ...     "return_mean": 1000.0, "return_std": 0.0, "return_median": 1000.0,
        ...     "episode_length_mean": 1000.0,
        ... })
        'sampled        return 1,000.0 ± 0.0 (median 1,000.0), length 1,000.0'
    """
    return (
        f"{kind:<14} return {scores['return_mean']:,.1f} ± {scores['return_std']:,.1f} "
        f"(median {scores['return_median']:,.1f}), length {scores['episode_length_mean']:,.1f}"
    )


def _no_run(folder: Path) -> UserError:
    return UserError(f"{folder} is not a run's folder (no readable config.yaml).")


Check = Callable[[Any], bool]


def _text(value: Any) -> bool:
    return isinstance(value, str) and value != "" and value.isprintable()


def _count(value: Any) -> bool:
    return type(value) is int and 0 <= value < 2**63


def _number(value: Any) -> bool:
    if type(value) is int:
        return _count(abs(value))
    return isinstance(value, float) and math.isfinite(value)


def _is(kind: type) -> Check:
    return lambda value: isinstance(value, kind)


def _or_none(check: Check) -> Check:
    return lambda value: value is None or check(value)


_SCORES: dict[str, Check] = dict.fromkeys(
    ("return_mean", "return_std", "return_median", "episode_length_mean"), _number
)
_NEEDED: dict[str, Check] = {
    **dict.fromkeys(("method", "task"), _text),
    **dict.fromkeys(("seed", "env_steps", "episodes"), _count),
    **_SCORES,
    "config_hash": _text,
}
_SECONDS_AND_RETURNS = (
    *("wall_seconds", "fit_seconds", "steps_per_second"),
    *("life_length_mean", "expert_return_mean", "demo_return_mean", "score_over_demo"),
)
# Some kinds of runs, and runs of earlier versions, do not have these.
_OPTIONAL: dict[str, Check] = {
    **dict.fromkeys(("seeds", "versions"), _is(dict)),
    **dict.fromkeys(("deterministic", "sampled"), _or_none(_is(dict))),
    **dict.fromkeys(("profile", "algorithm", "demo", "demo_id", "processor"), _or_none(_text)),
    **dict.fromkeys(_SECONDS_AND_RETURNS, _or_none(_number)),
    **dict.fromkeys(("inexact_resumes", "held_action"), _count),
    **dict.fromkeys(("demo_transitions", "demo_pairs"), _or_none(_count)),
    "random_policy": _is(bool),
}


def _first_wrong(result: dict[str, Any]) -> str | None:
    """The first entry of a ``result.json`` that no run writes."""
    for key, check in _NEEDED.items():
        if not check(result.get(key)):
            return key
    for key, check in _OPTIONAL.items():
        if key in result and not check(result[key]):
            return key
    for part, check in (("seeds", _count), ("versions", _text)):
        for key, value in result.get(part, {}).items():
            if not _or_none(check)(value):
                return f"{part}.{key}" if _text(key) else part
    for name in ("deterministic", "sampled"):
        other = result.get(name)
        for key, check in _SCORES.items():
            if other is not None and not check(other.get(key)):
                return f"{name}.{key}"
    return None
