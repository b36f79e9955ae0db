"""The player whose demonstration is imitated: PPO on the true reward, trained once and shared."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from torchrl.envs import Compose, SignTransform

from giril_rl.config.imports import import_modules, modules_of
from giril_rl.config.schema import ExpertConfig, ExpertRunConfig, RunConfig
from giril_rl.config.tasks import apply_task_defaults
from giril_rl.envs import gym_factory, make_env, with_own_episodes
from giril_rl.envs.families import spaces_of
from giril_rl.errors import UserError
from giril_rl.files.disk import missing, remove_empty
from giril_rl.policies.soft_actor_critic import check_squashable
from giril_rl.runs.finished import read_result
from giril_rl.runs.identity import out_folder
from giril_rl.runs.machine import check_device
from giril_rl.runs.run import Run
from giril_rl.training.algorithm import make_algorithm
from giril_rl.training.loop import train_policy
from giril_rl.training.outlook import announce
from giril_rl.training.ppo import return_scaling
from giril_rl.training.result import finish_run


def check_task(cfg: RunConfig) -> None:
    """Looks for environment and device, before a run's folder is made.

    The modules that ``cfg`` names are imported.

    Raises:
        UserError: if any of them is not there.
    """
    import_modules(modules_of(cfg), Path.cwd())
    check_device(cfg.device)
    gym_factory(cfg.task)
    if cfg.algorithm == "sac":
        check_squashable(spaces_of(cfg.task)[1])


def train_expert(
    cfg: ExpertRunConfig, folder: Path, *, recipe: str = "expert", announced: bool = False
) -> dict[str, Any]:
    """Trains PPO on the true reward and scores it, or returns what an earlier run left.

    Args:
        cfg: the expert's settings.
        folder: the run's folder.
        recipe: the recipe's name.
        announced: whether it was said already how long it may take.

    Returns:
        The contents of ``result.json``.

    Raises:
        Interrupted: after a checkpoint, if the user asked for it with Ctrl-C.
    """
    check_task(cfg)
    with Run.open(folder, asdict(cfg), recipe=recipe, logger=cfg.logger) as run:
        if run.finished:
            return read_result(folder)
        if not announced:
            announce(cfg)
        env = run.closing(make_env(cfg.task, cfg.learner.num_envs, cfg.seed, use="player"))
        learner = make_algorithm(env, cfg, run=run, use="player")
        trained = train_policy(
            env,
            learner,
            _transform(cfg),
            seed=cfg.seed,
            run=run,
            stop_at=cfg.task.expert_score if cfg.stop_early else None,
            use="player",
        )
        return finish_run(run, cfg, learner.agent, trained)


def _transform(cfg: ExpertRunConfig) -> Compose:
    if cfg.clip_reward:
        return Compose(SignTransform([("next", "reward")]))
    return Compose(*return_scaling(cfg))


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
        return folder, train_expert(settings, folder, announced=True)


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
