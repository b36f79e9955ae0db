"""A task's Gymnasium environments, registered by the packages that bring them."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Callable
from dataclasses import replace
from typing import cast

import gymnasium

from giril_rl.configs import TaskConfig
from giril_rl.envs.fixed import AfterFailure, FixedHorizonEnv
from giril_rl.envs.stdout import silent_stdout
from giril_rl.envs.vector import GymVectorEnv
from giril_rl.errors import UserError
from giril_rl.nearest import did_you_mean

BULLET = "BulletEnv"
BULLET_PACKAGE = "pybullet_envs_gymnasium"


def gym_factory(task: TaskConfig) -> Callable[[], gymnasium.Env]:
    """A function that makes one Gymnasium environment of ``task``, time limit included.

    Args:
        task: the task; ids ending in ``BulletEnv-v0`` come from ``pybullet_envs_gymnasium``.

    Raises:
        UserError: if the id is unknown, its package is missing, or it has no time limit.

    Examples:
        >>> gym_factory(TaskConfig(name="cartpole", env_id="CartPole-v1"))().spec.id
        'CartPole-v1'
    """
    if BULLET in task.env_id:
        _import(BULLET_PACKAGE)
    try:
        spec = gymnasium.spec(task.env_id)
    except gymnasium.error.Error:
        hint = did_you_mean(task.env_id, gymnasium.registry) or "; check its name and package."
        raise UserError(f"task.env_id={task.env_id} is not a Gymnasium id{hint}") from None
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
                env = gymnasium.make(task.env_id, max_episode_steps=limit, disable_env_checker=True)
                if bullet:
                    env.reset()
        except gymnasium.error.DependencyNotInstalled as error:
            raise UserError(f"{task.env_id} needs another package: {error}") from None
        return env

    return make


def make_env(task: TaskConfig, num_envs: int, seed: int) -> GymVectorEnv:
    """``num_envs`` environments of ``task`` as one TorchRL environment.

    Args:
        task: the task; ``task.horizon="fixed"`` makes a :class:`FixedHorizonEnv`.
        num_envs: batch size.
        seed: root of the episodes' seeds.

    Raises:
        UserError: as :func:`gym_factory`, and for spaces that are no vectors.

    Examples:
        >>> env = make_env(TaskConfig(name="cartpole", env_id="CartPole-v1"), num_envs=3, seed=0)
        >>> env.reset()["observation"].shape
        torch.Size([3, 4])
    """
    if task.horizon == "fixed":
        return FixedHorizonEnv(
            gym_factory(task),
            num_envs,
            after_failure=cast(AfterFailure, task.after_failure),
            seed=seed,
        )
    return GymVectorEnv(gym_factory(task), num_envs, seed=seed)


def with_own_episodes(task: TaskConfig) -> TaskConfig:
    """The task with its own episodes, which end at a failure: what experts and scores play.

    Examples:
        >>> fixed = TaskConfig(name="cartpole", env_id="CartPole-v1", horizon="fixed")
        >>> with_own_episodes(fixed).horizon
        'own'
    """
    return replace(task, horizon="own", after_failure="reset")


def _import(package: str) -> None:
    try:
        importlib.import_module(package)
    except ImportError:
        raise UserError(
            f"this task needs {package}, which is not installed: pip install {package}."
        ) from None
