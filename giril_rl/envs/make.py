"""A task's environments, registered by the packages that bring them."""

from __future__ import annotations

import contextlib
import importlib
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import cast

import gymnasium

from giril_rl.config.nearest import did_you_mean
from giril_rl.config.schema import TaskConfig, split_id
from giril_rl.envs.atari import AtariEnv, Episode
from giril_rl.envs.atari_game import FRAME_CAP
from giril_rl.envs.atari_gym import AtariGymEnv
from giril_rl.envs.batched import BatchedEnv
from giril_rl.envs.fixed import AfterFailure, FixedHorizonEnv
from giril_rl.envs.stdout import silent_stdout
from giril_rl.envs.vector import GymVectorEnv
from giril_rl.errors import UserError
from giril_rl.runs.randomness import Use

BULLET = "BulletEnv"
BULLET_PACKAGE = "pybullet_envs_gymnasium"


def gym_factory(task: TaskConfig) -> Callable[[], gymnasium.Env]:
    """A function that makes one Gymnasium environment of ``task``, time limit included.

    Args:
        task: the task; ids ending in ``BulletEnv-v0`` come from ``pybullet_envs_gymnasium``, those
            that begin with ``ALE/`` are :class:`AtariGymEnv`, preprocessed. ``MODULE:ID`` is one
            that a module registers, which the caller has imported: the task may be of a run that
            somebody sent.

    Raises:
        UserError: if the id is unknown, its module or package is missing, or it has no time limit.

    Examples:
        >>> gym_factory(TaskConfig(name="cartpole", env_id="CartPole-v1"))().spec.id
        'CartPole-v1'
    """
    if task.is_atari:
        game = _game(task)

        def make_game() -> gymnasium.Env:
            env = AtariGymEnv(game, episode=cast(Episode, task.episode), frame_cap=_frames(task))
            env.spec = _spec(task)
            return env

        return make_game
    if BULLET in task.env_id:
        _import(BULLET_PACKAGE)
    spec = _spec(task)
    limit = task.max_episode_steps or spec.max_episode_steps
    if limit is None:
        raise UserError(
            f"{task.env_id} has no time limit, so that an episode may never end: "
            "set task.max_episode_steps."
        )

    def make() -> gymnasium.Env:
        # pybullet prints on both streams, when imported and whenever it connects, at a first reset.
        bullet = BULLET in task.env_id
        try:
            with silent_stdout(stderr=True) if bullet else contextlib.nullcontext():
                env = gymnasium.make(spec.id, max_episode_steps=limit, disable_env_checker=True)
                if bullet:
                    env.reset()
        except gymnasium.error.DependencyNotInstalled as error:
            raise UserError(f"{task.env_id} needs another package: {error}") from None
        return env

    return make


def _spec(task: TaskConfig) -> gymnasium.envs.registration.EnvSpec:
    module, env_id = split_id(task.env_id)
    if module is not None and module not in sys.modules:
        raise UserError(
            f"task.env_id={task.env_id} is not a Gymnasium id here: its module {module} is not "
            f"imported; name it with imports=[{module}] or --import {module}, or import it."
        )
    try:
        return gymnasium.spec(env_id)
    except gymnasium.error.Error:
        if module is not None:
            who = f"is not a Gymnasium id that {module} registers"
            hint = did_you_mean(env_id, gymnasium.registry) or ": check its name."
        else:
            who = "is not a Gymnasium id"
            hint = did_you_mean(env_id, gymnasium.registry) or (
                "; check its name, or name the module that registers it: MODULE:ID."
            )
        raise UserError(f"task.env_id={task.env_id} {who}{hint}") from None


def _game(task: TaskConfig) -> str:
    """The name of an Atari task's ROM."""
    _import("ale_py", extra="atari")  # Registers the ids.
    return str(_spec(task).kwargs["game"])


def _frames(task: TaskConfig) -> int:
    return FRAME_CAP if task.max_episode_steps is None else 4 * task.max_episode_steps


def make_env(task: TaskConfig, num_envs: int, seed: int, *, use: Use = "training") -> BatchedEnv:
    """``num_envs`` environments of ``task`` as one TorchRL environment.

    Args:
        task: the task; ``task.horizon="fixed"`` makes a :class:`FixedHorizonEnv`, an id of the
            Arcade Learning Environment an :class:`AtariEnv`.
        num_envs: batch size.
        seed: root of the episodes' seeds.
        use: what the episodes are for; those of two uses never have equal seeds.

    Raises:
        UserError: as :func:`gym_factory`, and for spaces that are no vectors.

    Examples:
        >>> env = make_env(TaskConfig(name="cartpole", env_id="CartPole-v1"), num_envs=3, seed=0)
        >>> env.reset()["observation"].shape
        torch.Size([3, 4])
    """
    if task.is_atari:
        return AtariEnv(
            _game(task),
            num_envs,
            episode=cast(Episode, task.episode),
            seed=seed,
            use=use,
            frame_cap=_frames(task),
        )
    if task.horizon == "fixed":
        return FixedHorizonEnv(
            gym_factory(task),
            num_envs,
            after_failure=cast(AfterFailure, task.after_failure),
            seed=seed,
            use=use,
        )
    return GymVectorEnv(gym_factory(task), num_envs, seed=seed, use=use)


def for_scores(task: TaskConfig) -> TaskConfig:
    """The task as scores are counted: its own episodes, and whole games.

    Examples:
        >>> for_scores(TaskConfig(name="pong", env_id="ALE/Pong-v5", episode="life")).episode
        'game'
    """
    return replace(with_own_episodes(task), episode="game")


def with_own_episodes(task: TaskConfig) -> TaskConfig:
    """The task with its own episodes, which end at a failure or a lost life: what experts play.

    Examples:
        >>> fixed = TaskConfig(name="cartpole", env_id="CartPole-v1", horizon="fixed")
        >>> with_own_episodes(fixed).horizon
        'own'
    """
    return replace(task, horizon="own", after_failure="reset", episode="life")


def _import(package: str, extra: str | None = None) -> None:
    try:
        importlib.import_module(package)
    except ImportError:
        command = f'pip install "giril-rl[{extra}]"' if extra else f"pip install {package}"
        raise UserError(f"this task needs {package}, which is not installed: {command}.") from None
