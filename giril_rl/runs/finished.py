"""Reading what a run left behind."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import yaml

from giril_rl.config.schema import EvalConfig, TaskConfig
from giril_rl.config.validation import validate
from giril_rl.errors import UserError
from giril_rl.files.formats import check_run_format
from giril_rl.files.untrusted import parse_yaml, read_text
from giril_rl.runs.result_file import read_result_file

Part = TypeVar("Part")


def read_result(folder: Path) -> dict[str, Any]:
    """A finished run's ``result.json``.

    Raises:
        UserError: if the folder holds no finished run, one of a later format or a damaged one.
    """
    check_run_format(folder)
    path = folder / "result.json"
    if not path.exists():
        raise UserError(
            f"{folder} holds no finished run (no result.json): run it to its end first."
        )
    return read_result_file(path)


def read_settings(folder: Path) -> tuple[TaskConfig, EvalConfig]:
    """A run's task, policy and evaluation settings, from its ``config.yaml``.

    Raises:
        UserError: if the file is missing or is not what a run writes.
    """
    config = read_config(folder)
    return (
        read_part(folder, config, "task", TaskConfig),
        read_part(folder, config, "eval", EvalConfig),
    )


def read_config(folder: Path) -> dict[str, Any]:
    """What a run's ``config.yaml`` holds, nested.

    Raises:
        UserError: if the file is missing or is not what a run writes.
    """
    try:
        config = parse_yaml(read_text(folder / "config.yaml"))
    except (OSError, ValueError, yaml.YAMLError):
        raise _no_run(folder) from None
    if not isinstance(config, dict):
        raise _no_run(folder)
    return config


def read_part(folder: Path, config: dict[str, Any], name: str, kind: type[Part]) -> Part:
    """One part of :func:`read_config`'s settings as the dataclass that it was made of.

    Keys that the dataclass does not have are passed over.

    Raises:
        UserError: if there is no such part.
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
    """Prints a finished run's scores, beside its expert's and its demonstration's."""
    result = read_result(folder)
    print(f"{result['method']} on {result['task']}: {result['env_steps']:,} steps, {folder}")
    for who in ("expert", "demo"):
        score = result.get(f"{who}_return_mean")
        if score is not None:
            print(f"{who:<14} return {score:,.1f}")
    print_both(result)


def print_both(scores: dict[str, Any]) -> None:
    print(describe("sampled", scores))
    if scores.get("deterministic") is not None:  # Runs of an early version have none.
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
