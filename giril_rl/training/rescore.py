"""Scoring a finished run's policy again."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import yaml
from filelock import FileLock, Timeout

from giril_rl.config.imports import named_modules
from giril_rl.config.schema import EvalConfig, TaskConfig
from giril_rl.errors import UserError
from giril_rl.files.disk import check_place, write_atomically, write_json
from giril_rl.policies.making import load_agent
from giril_rl.runs.finished import (
    print_both,
    read_config,
    read_part,
    read_result,
    read_settings,
)
from giril_rl.training.baselines import HELD_ACTION, RANDOM, HeldAction, RandomPolicy
from giril_rl.training.result import score_over_demonstration
from giril_rl.training.scoring import Player, evaluate_both


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
    print_both(scores)


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
            over = score_over_demonstration(scores["return_mean"], result.get("demo_return_mean"))
            anew = {**result, **scores, "score_over_demo": over, "seeds": seeds}
            write_json(folder / "result.json", anew)
    except Timeout:
        raise UserError(f"{folder} is in use by another process: wait for it to end.") from None


def _player(folder: Path, task: TaskConfig, result: dict[str, Any]) -> Player:
    """Who played a finished run's scores."""
    if result.get("random_policy") or result["method"] == RANDOM:
        return RandomPolicy.of_task(task, result["seed"])
    if "held_action" in result or result["method"] == HELD_ACTION:
        return HeldAction.of_task(task, result.get("held_action", -1))
    return load_agent(folder, task)
