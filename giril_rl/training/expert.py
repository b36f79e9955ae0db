"""The player and its demonstration: made once, then shared by all runs that ask for the same."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import sys
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import Compose, SignTransform
from torchrl.envs.utils import ExplorationType, set_exploration_type

from giril_rl.config.imports import import_modules, modules_of
from giril_rl.config.schema import DemoConfig, ExpertConfig, ExpertRunConfig, RunConfig, TaskConfig
from giril_rl.config.tasks import apply_task_defaults
from giril_rl.demos import Demonstration, check_demonstration, record_demonstration
from giril_rl.demos.shipped import demonstration_folder
from giril_rl.demos.task import as_recorded_task, check_environment, spaces_of
from giril_rl.envs import gym_factory, make_env, with_own_episodes
from giril_rl.errors import UserError
from giril_rl.files.disk import missing, remove_empty, remove_leftovers
from giril_rl.policies.agent import load_agent, make_agent
from giril_rl.policies.agents import Agent
from giril_rl.runs.finished import read_result
from giril_rl.runs.naming import NO_EFFECT, out_folder, safe, without_added
from giril_rl.runs.randomness import check_device
from giril_rl.runs.run import Run
from giril_rl.training.outlook import announce
from giril_rl.training.ppo import train_ppo
from giril_rl.training.result import finish_run
from giril_rl.training.scaling import return_scaling

REWARD = [("next", "reward")]


def train_expert(cfg: ExpertRunConfig, folder: Path, *, recipe: str = "expert") -> dict[str, Any]:
    """Trains PPO on the true reward and scores it, or returns what an earlier run left.

    Args:
        cfg: the expert's settings.
        folder: the run's folder.
        recipe: the recipe's name.

    Returns:
        The contents of ``result.json``.

    Raises:
        Interrupted: after a checkpoint, if the user asked for it with Ctrl-C.
    """
    check_task(cfg)
    with Run.open(folder, asdict(cfg), recipe=recipe, logger=cfg.logger) as run:
        if run.finished:
            return read_result(folder)
        env = run.closing(make_env(cfg.task, cfg.ppo.num_envs, cfg.seed, use="player"))
        agent = make_agent(env, cfg.ppo, cfg.seed, use="player").to(cfg.device)
        relabel = (
            [SignTransform(REWARD)]
            if cfg.clip_reward
            else return_scaling(cfg.scaling, cfg.ppo.gamma)
        )
        trained = train_ppo(
            env,
            agent,
            Compose(*relabel),
            cfg.ppo,
            steps=cfg.steps,
            seed=cfg.seed,
            run=run,
            stop_at=cfg.task.expert_score if cfg.stop_early else None,
            use="player",
        )
        return finish_run(run, cfg, agent, trained)


def obtain_expert(cfg: RunConfig, expert: ExpertConfig) -> tuple[Path, dict[str, Any]]:
    """The folder and result of the expert that a recipe asks for, trained first if need be.

    Args:
        cfg: the recipe's settings, of which task and root are shared.
        expert: the expert's own.

    Raises:
        UserError: if ``expert.path`` is no finished run of this task.
    """
    if expert.path is not None:
        folder = Path(expert.path)
        result = read_result(folder)
        if result["task"] != cfg.task.name:
            raise UserError(
                f"expert.path={folder} plays {result['task']}, not {cfg.task.name}: "
                "choose an expert of the same task."
            )
        return folder, result
    settings = expert_settings(cfg, expert)
    folder = out_folder("expert", settings, {})
    with made_once(folder, "expert"):
        return folder, train_expert(settings, folder)


def expert_settings(cfg: RunConfig, expert: ExpertConfig) -> ExpertRunConfig:
    """The settings of the expert that a recipe asks for, unless it is given by its path."""
    return apply_task_defaults(
        ExpertRunConfig(
            task=with_own_episodes(cfg.task),
            root=cfg.root,
            imports=cfg.imports,
            logger=cfg.logger,
            threads=cfg.threads,
            device=cfg.device,
            steps=expert.steps_on(cfg.task),
            seed=cfg.seed if expert.seed is None else expert.seed,
            stop_early=expert.stop_early,
        )
    )


def check_task(cfg: RunConfig) -> None:
    """Looks for environment and device, before a run's folder is made.

    The modules that ``cfg`` names are imported.

    Raises:
        UserError: if any of them is not there.
    """
    import_modules(modules_of(cfg), Path.cwd())
    check_device(cfg.device)
    gym_factory(cfg.task)


def check_inputs(cfg: RunConfig, expert: ExpertConfig, demo: DemoConfig) -> None:
    """Looks at whatever a recipe was given by its path, before its run's folder is made.

    Raises:
        UserError: if the task, the expert or the demonstration is not what it should be.
    """
    check_task(cfg)
    if demo.path is not None:
        _given_demonstration(cfg, demo.path)
    elif expert.path is not None:
        folder, _ = obtain_expert(cfg, expert)
        load_agent(folder, cfg.task)


def _given_demonstration(cfg: RunConfig, path: str) -> Demonstration:
    task = cfg.task
    folder = demonstration_folder(path, task, cfg.seed)
    shape, spec = spaces_of(task)
    demo = Demonstration.load(folder)
    try:
        check_environment(demo, task)
        check_demonstration(demo, shape, spec)
    except UserError as error:
        raise UserError(f"demo.path={path} does not fit {task.name}: {error}") from None
    return demo


def obtain_demonstration(
    cfg: RunConfig, expert: ExpertConfig, demo: DemoConfig
) -> tuple[Demonstration, dict[str, Any] | None]:
    """The demonstration that a recipe asks for, recorded first if need be, and its expert's result.

    Of a demonstration that was given by its path the latter has ``return_mean`` where its card
    tells it, and is None otherwise.

    Raises:
        UserError: if the demonstration does not fit the task.
    """
    settings = expert_settings(cfg, expert)
    has_player = (out_folder("expert", settings, {}) / "result.json").exists()
    announce(cfg, expert, demo, has_player=has_player)
    if demo.path is not None:
        given = _given_demonstration(cfg, demo.path)
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
                lives=demo.lives if task.is_atari else None,
            )
            recorded.save(folder)
    return Demonstration.load(folder), result


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
    unread = {"path", "subsample"} | (set() if task.is_atari else {"lives"})
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


@contextlib.contextmanager
def made_once(folder: Path, what: str) -> Iterator[None]:
    """Lets one process make ``folder`` while others that want it wait.

    Where that is refused, nothing is left behind.
    """
    made = missing(folder.parent)
    folder.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(str(folder.parent / f".{folder.name}.lock"))
    try:
        lock.acquire(timeout=0)
    except Timeout:
        print(f"waiting for another run that is making the {what} {folder}", file=sys.stderr)
        lock.acquire()
    refused = False
    try:
        yield
    except UserError:
        refused = not folder.exists()
        raise
    finally:
        lock.release()
        if refused:
            Path(lock.lock_file).unlink(missing_ok=True)
            remove_empty(made)
