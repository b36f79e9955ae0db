"""How a recipe begins: its run opened, its demonstration found or recorded once and shared."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from giril_rl.config.schema import DemoConfig, DemoRunConfig, ExpertConfig, RunConfig, TaskConfig
from giril_rl.demos import (
    Demonstration,
    check_demonstration,
    record_demonstration,
    shortened,
)
from giril_rl.demos.check import check_environment
from giril_rl.demos.shipped import demonstration_folder, is_shipped
from giril_rl.envs import gym_factory
from giril_rl.envs.families import as_recorded_task, spaces_of
from giril_rl.errors import UserError
from giril_rl.files.disk import remove_leftovers
from giril_rl.policies.agent import Agent
from giril_rl.policies.making import load_agent
from giril_rl.runs.finished import read_config, read_part, read_result
from giril_rl.runs.identity import NO_EFFECT, config_hash, out_folder, safe, without_added
from giril_rl.runs.run import Run
from giril_rl.training.algorithm import check_replay
from giril_rl.training.experts import check_task, expert_settings, made_once, obtain_expert
from giril_rl.training.outlook import announce


def open_run(cfg: RunConfig, out: Path, *, recipe: str) -> Run:
    """A run's folder, new or continued, once whatever the settings name was found.

    Args:
        cfg: the run's settings.
        out: the folder.
        recipe: the recipe's name: ``Path(__file__).stem``.

    Raises:
        UserError: if the task, the expert or the demonstration is not what it should be, or the
            folder holds something else.
    """
    if isinstance(cfg, DemoRunConfig) and cfg.needs_demonstration:
        check_inputs(cfg)
        # How long it will take is said once the demonstration is looked for.
        return Run.open(out, asdict(cfg), recipe=recipe, logger=cfg.logger)
    check_task(cfg)
    run = Run.open(out, asdict(cfg), recipe=recipe, logger=cfg.logger)
    if not run.finished:
        announce(cfg)
    return run


def check_inputs(
    cfg: DemoRunConfig, expert: ExpertConfig | None = None, demo: DemoConfig | None = None
) -> None:
    """Looks at whatever a recipe was given by its path, before its run's folder is made.

    Raises:
        UserError: if the task, the expert or the demonstration is not what it should be.
    """
    expert, demo = expert or cfg.expert, demo or cfg.demo
    check_task(cfg)
    if demo.path is not None:
        _given_demonstration(cfg, demo)
    elif expert.path is not None:
        folder, _ = obtain_expert(cfg, expert)
        load_agent(folder, cfg.task)


def _given_demonstration(cfg: DemoRunConfig, chosen: DemoConfig) -> Demonstration:
    task, path = cfg.task, str(chosen.path)
    folder = demonstration_folder(path, task, cfg.seed)
    shape, spec = spaces_of(task)
    demo = Demonstration.load(folder)
    try:
        check_environment(demo, task)
        check_demonstration(demo, shape, spec)
    except UserError as error:
        raise UserError(f"demo.path={path} does not fit {task.name}: {error}") from None
    if not demo.has_actions and cfg.needs_actions is not None:
        raise UserError(f"demo.path={path} has no actions, which {cfg.needs_actions}.")
    return _used_part(demo, cfg, chosen)


def _used_part(demo: Demonstration, cfg: RunConfig, chosen: DemoConfig) -> Demonstration:
    used = shortened(demo, episodes=chosen.episodes, first=chosen.first)
    check_replay(cfg, used)
    return used


def obtain_demonstration(
    cfg: DemoRunConfig, expert: ExpertConfig | None = None, demo: DemoConfig | None = None
) -> tuple[Demonstration, dict[str, Any] | None]:
    """The demonstration that a recipe asks for, recorded first if need be, and its expert's result.

    It is as much of it as ``demo.episodes`` and ``demo.first`` say. Of a given demonstration the
    result has only ``return_mean``, if its card tells it, and is None
    otherwise.

    Args:
        cfg: the recipe's settings.
        expert: the expert's settings; None takes those of ``cfg``.
        demo: the demonstration's; None takes those of ``cfg``.

    Raises:
        UserError: if the demonstration does not fit the task, has no actions where they are read,
            or is shorter than what is to be used of it.
    """
    expert, demo = expert or cfg.expert, demo or cfg.demo
    settings = expert_settings(cfg, expert)
    has_player = (out_folder("expert", settings, {}) / "result.json").exists()
    announce(cfg, expert, demo, has_player=has_player)
    if demo.path is not None:
        given = _given_demonstration(cfg, demo)
        return given, _known_expert(given)
    source, result = obtain_expert(cfg, expert)
    task = as_recorded_task(cfg.task, demo.lives)
    folder = Path(cfg.root) / demonstration_place(cfg, demo, result["config_hash"])
    with made_once(folder, "demonstration"):
        remove_leftovers(folder)
        if not folder.exists():
            agent = load_agent(source, cfg.task)
            recorded = record_demonstration(
                gym_factory(task),
                _player(agent, deterministic=demo.deterministic),
                seed=cfg.seed if demo.seed is None else demo.seed,
                length=demo.length,
                episodes=demo.episodes,
                deterministic=demo.deterministic,
                task=task.name,
                expert={key: result[key] for key in ("return_mean", "seed", "env_steps")},
                lives=demo.lives if task.family.has_lives else None,
            )
            recorded.save(folder)
    return _used_part(Demonstration.load(folder), cfg, demo), result


def _known_expert(demo: Demonstration) -> dict[str, Any] | None:
    player = demo.card.get("expert")
    score = player.get("return_mean") if isinstance(player, dict) else None
    if isinstance(score, float | int) and math.isfinite(score):
        return {"return_mean": float(score)}
    return None


def demonstration_place(cfg: RunConfig, demo: DemoConfig, expert: str) -> Path:
    """Where a recorded demonstration lies below the root of runs.

    Args:
        cfg: the recipe's settings, of which task and seed count.
        demo: what is recorded.
        expert: the expert's ``config_hash``.

    Examples:
        >>> pong = RunConfig(task=TaskConfig(name="pong", env_id="ALE/Pong-v5"))
        >>> demonstration_place(pong, DemoConfig(), "0123456789ab").parent.as_posix()
        'demos/pong'
    """
    demo = replace(demo, seed=cfg.seed if demo.seed is None else demo.seed)
    identity = _identity(as_recorded_task(cfg.task, demo.lives), demo, expert)
    return Path("demos") / safe(cfg.task.name) / identity


def _identity(task: TaskConfig, demo: DemoConfig, expert: str) -> str:
    """Twelve hex digits of what decides a demonstration."""
    unread = {"path", "subsample", "first"} | (set() if task.family.has_lives else {"lives"})
    chosen = {key: value for key, value in asdict(demo).items() if key not in unread}
    parts = without_added({"demo": chosen, "task": asdict(task)}, drop=NO_EFFECT)
    identity = json.dumps([parts["demo"], parts["task"], expert], sort_keys=True)
    return hashlib.sha256(identity.encode()).hexdigest()[:12]


def _player(agent: Agent, *, deterministic: bool) -> Any:
    policy = agent.acting()
    mode = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM

    def play(observation: Tensor) -> Tensor:
        with set_exploration_type(mode):
            batch = TensorDict({"observation": observation}, observation.shape[:1])
            return policy(batch)["action"]

    return play


def find_demonstration(folder: Path, within: Path) -> Demonstration | None:
    """The demonstration of a finished run where it is still there; none is recorded for want of it.

    It is looked for where the run's settings say, and, for runs that were moved or copied since and
    for settings of another current directory, in the same way in each folder from the run's up to
    ``within``. The settings of a run that somebody sent may name any file, so nothing that lies
    elsewhere is read.

    Args:
        folder: the run's folder.
        within: the folder above it outside of which nothing is read.

    Returns:
        The demonstration, or None if it is not there, or is another one than at the time of the
        run.

    Raises:
        UserError: if it is there and damaged, or the run's settings are not what a run writes.
    """
    config, result = read_config(folder), read_result(folder)
    demo = read_part(folder, config, "demo", DemoConfig)
    place: Path | None
    if demo.path is not None and is_shipped(demo.path):
        task = read_part(folder, config, "task", TaskConfig)
        place = demonstration_folder(demo.path, task, result["seed"])
    else:
        places = _places(folder, within, config, result, demo)
        place = next((path for path in places if _is_inside(path / "card.json", within)), None)
    if place is None:
        return None
    try:
        found = shortened(Demonstration.load(place), episodes=demo.episodes, first=demo.first)
    except UserError:
        return None
    return found if len(found) == result.get("demo_transitions") else None


def _places(
    folder: Path, within: Path, config: dict[str, Any], result: dict[str, Any], demo: DemoConfig
) -> Iterator[Path]:
    """Where the demonstration may lie."""
    if demo.path is not None:
        yield from _readings(demo.path, folder, within)
        return
    root = config.get("root", "runs")
    if not isinstance(root, str):
        raise UserError(f"{folder / 'config.yaml'}: root={root}: text is needed.")
    task = read_part(folder, config, "task", TaskConfig)
    expert = read_part(folder, config, "expert", ExpertConfig)
    run = RunConfig(task=task, seed=result["seed"])
    made_by = None
    if expert.path is None:
        made_by = config_hash(expert_settings(run, expert))
    else:
        for place in _readings(expert.path, folder, within):
            if _is_inside(place / "result.json", within):
                made_by = str(read_result(place)["config_hash"])
                break
    if made_by is not None:
        below = demonstration_place(run, demo, made_by)
        for place in (*_readings(root, folder, within), *_above(folder, within)):
            yield place / below


def _readings(path: str, folder: Path, within: Path) -> Iterator[Path]:
    """What a path in a run's settings may mean: as it is, and below each folder above the run's."""
    yield Path(path)
    for above in _above(folder, within):
        yield above / path


def _above(folder: Path, within: Path) -> list[Path]:
    """The folders above a run's, up to and with ``within``."""
    top = within.resolve()
    return [path for path in folder.resolve().parents if path.is_relative_to(top)]


def _is_inside(file: Path, within: Path) -> bool:
    """Whether there is such a file, wherever links lead, below ``within``."""
    try:
        return file.resolve().is_relative_to(within.resolve()) and file.is_file()
    except (OSError, ValueError, RuntimeError):  # A null byte, a name too long, links in a circle.
        return False
