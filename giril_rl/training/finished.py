"""Reading what a run left behind."""

from __future__ import annotations

import sys
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, TypeVar

import yaml
from filelock import FileLock, Timeout

from giril_rl.configs import EvalConfig, TaskConfig
from giril_rl.errors import UserError
from giril_rl.files import write_atomically, write_json
from giril_rl.formats import check_run_format
from giril_rl.imports import named_modules
from giril_rl.places import check_place
from giril_rl.schema import leaves
from giril_rl.training.agent import load_agent
from giril_rl.training.evaluate import Player, evaluate_both
from giril_rl.training.held_action import HELD_ACTION, HeldAction
from giril_rl.training.random_policy import RANDOM, RandomPolicy
from giril_rl.training.result_file import read_result_file
from giril_rl.untrusted import parse_yaml, read_text
from giril_rl.validation import validate

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
        for leaf in leaves(kind):
            if not leaf.takes(getattr(part, leaf.key)):
                raise UserError(f"{leaf.key}={getattr(part, leaf.key)}: {leaf.needed} is needed.")
        validate(part)
    except UserError as error:
        raise UserError(f"{folder / 'config.yaml'}: {name}.{error}") from None
    return part


def evaluate_run(folder: Path, episodes: int | None = None, seed: int | None = None) -> None:
    """Scores a finished run's policy again and prints the scores; ``eval.json`` keeps them.

    ``result.json`` stays as it is.

    Args:
        folder: the run's folder.
        episodes: episodes of each kind; None takes the run's own setting.
        seed: root of the episodes' seeds; None takes the run's own setting.

    Raises:
        UserError: if the folder holds no finished run, or its environment is of a module that is
            not imported: reading a run imports nothing that it names.
    """
    result = read_result(folder)
    task, settings = read_settings(folder)
    check_place(folder, "folder, such as a copy of it")
    for module in named_modules(task.env_id, read_config(folder).get("imports")):
        if module not in sys.modules:
            raise UserError(
                f"{folder} names the module {module}, and reading a run imports nothing: if you "
                f"trust it, add --import {module}."
            )
    episodes = settings.episodes if episodes is None else episodes
    seed = settings.seed if seed is None else seed
    player = _player(folder, task, result)
    scores = evaluate_both(player, task, episodes=episodes, seed=seed)
    write_json(folder / "eval.json", {"task": task.name, "eval_seed": seed, **scores})
    print(f"{task.name}, {episodes} episodes each, evaluation seed {seed}")
    _print_both(scores)


def score_anew(folder: Path, settings: EvalConfig) -> None:
    """Scores a finished run's policy by other settings, and puts the scores into ``result.json``.

    Args:
        folder: the run's folder.
        settings: the run's evaluation settings from now on.

    Raises:
        UserError: if the folder holds no finished run, or another process uses it.
    """
    result, config = read_result(folder), read_config(folder)
    task = read_part(folder, config, "task", TaskConfig)
    print(
        f"giril: {folder} was finished earlier: its policy is scored anew, in {settings.episodes} "
        f"episodes of the seed {settings.seed}; nothing is trained.",
        file=sys.stderr,
    )
    try:
        with FileLock(str(folder / ".lock"), timeout=0):
            scores = evaluate_both(
                _player(folder, task, result),
                task,
                episodes=settings.episodes,
                seed=settings.seed,
            )
            text = yaml.safe_dump({**config, "eval": asdict(settings)}, sort_keys=False)
            write_atomically(folder / "config.yaml", text)
            seeds = {**result.get("seeds", {}), "evaluation": settings.seed}
            write_json(folder / "result.json", {**result, **scores, "seeds": seeds})
    except Timeout:
        raise UserError(f"{folder} is in use by another process: wait for it to end.") from None


def _player(folder: Path, task: TaskConfig, result: dict[str, Any]) -> Player:
    """Who played a finished run's scores."""
    if result.get("random_policy") or result["method"] == RANDOM:
        return RandomPolicy.of_task(task, result["seed"])
    if "held_action" in result or result["method"] == HELD_ACTION:
        return HeldAction.of_task(task, result.get("held_action", -1))
    return load_agent(folder, task)


def print_scores(folder: Path) -> None:
    """Prints a finished run's scores, beside its expert's and its demonstration's."""
    result = read_result(folder)
    print(f"{result['method']} on {result['task']}: {result['env_steps']:,} steps, {folder}")
    for who in ("expert", "demo"):
        score = result.get(f"{who}_return_mean")
        if score is not None:
            print(f"{who:<14} return {score:,.1f}")
    _print_both(result)


def _print_both(scores: dict[str, Any]) -> None:
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
