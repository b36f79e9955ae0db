"""From a task to its environment: the registry of env families, and how episodes are counted.

What settings know of a family is in :mod:`giril_rl.config.families`. How its environments are made
is here: Gymnasium and PyBullet in :mod:`giril_rl.envs.gymnasium_family`, Atari in
:mod:`giril_rl.envs.atari_family`, one file for each family.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from typing import NamedTuple

import gymnasium
import torch
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase

from giril_rl.config.families import (
    ATARI,
    GYMNASIUM,
    Observation,
    TaskFamily,
    register_task_family,
)
from giril_rl.config.schema import TaskConfig
from giril_rl.envs import atari_family, gymnasium_family
from giril_rl.envs.batched import BatchedEnv
from giril_rl.runs.randomness import Use

GymFactory = Callable[[TaskConfig], Callable[[], gymnasium.Env]]


MakeEnv = Callable[[TaskConfig, int, int, Use], BatchedEnv]
"""From a task, a number of environments, a seed and their use."""


class _Makers(NamedTuple):
    gym_factory: GymFactory
    make: MakeEnv


_makers = {
    ATARI.name: _Makers(atari_family.gym_factory, atari_family.make),
    GYMNASIUM.name: _Makers(gymnasium_family.gym_factory, gymnasium_family.make),
}


def register_family(
    family: TaskFamily,
    *,
    gym_factory: GymFactory = gymnasium_family.gym_factory,
    make: MakeEnv = gymnasium_family.make,
) -> None:
    """Adds a family of tasks, whose ids then go before the families that are there.

    Args:
        family: its ids, its observations and its default settings.
        gym_factory: from a task to a function that makes one Gymnasium environment, in which
            demonstrations are recorded and replayed; by default what Gymnasium has registered.
        make: makes the batched environment that a policy is trained in; by default a
            :class:`~giril_rl.envs.GymVectorEnv`, or a :class:`~giril_rl.envs.GymImageEnv` for a
            family with images.

    Examples:
        >>> boxes = TaskFamily("boxes", "Boxes/", observation="image", settings="atari")
        >>> register_family(boxes)
        >>> TaskConfig(name="push", env_id="my_envs:Boxes/Push-v0").family.name
        'boxes'
    """
    register_task_family(family)
    _makers[family.name] = _Makers(gym_factory, make)


def gym_factory(task: TaskConfig) -> Callable[[], gymnasium.Env]:
    """A function that makes one Gymnasium environment of ``task``, time limit included.

    Args:
        task: the task; ids ending in ``BulletEnv-v0`` come from ``pybullet_envs_gymnasium``, those
            that begin with ``ALE/`` are :class:`AtariGymEnv`, preprocessed. ``MODULE:ID`` names the
            module that registers the id; the caller must have imported it, as the task may be of
            a run that somebody sent.

    Raises:
        UserError: if the id is unknown, its module or package is missing, or it has no time limit.

    Examples:
        >>> gym_factory(TaskConfig(name="cartpole", env_id="CartPole-v1"))().spec.id
        'CartPole-v1'
    """
    return _makers[task.family.name].gym_factory(task)


def make_env(task: TaskConfig, num_envs: int, seed: int, *, use: Use = "training") -> BatchedEnv:
    """``num_envs`` environments of ``task`` as one TorchRL environment.

    Args:
        task: the task. An id that begins with ``ALE/`` makes an :class:`AtariEnv`, every other a
            :class:`GymVectorEnv`, or a :class:`FixedHorizonEnv` with ``task.horizon="fixed"``.
        num_envs: batch size.
        seed: root of the episodes' seeds.
        use: what the episodes are for; two uses never share seeds.

    Raises:
        UserError: as :func:`gym_factory`, and for spaces that the family does not support.

    Examples:
        >>> env = make_env(TaskConfig(name="cartpole", env_id="CartPole-v1"), num_envs=3, seed=0)
        >>> env.reset()["observation"].shape
        torch.Size([3, 4])
    """
    return _makers[task.family.name].make(task, num_envs, seed, use)


def observation_kind(env: EnvBase) -> Observation:
    """Whether an environment shows images, which are bytes, or vectors.

    Examples:
        >>> observation_kind(make_env(TaskConfig(name="pong", env_id="ALE/Pong-v5"), 1, seed=0))
        'image'
    """
    return "image" if env.observation_spec["observation"].dtype == torch.uint8 else "vector"


def spaces_of(task: TaskConfig) -> tuple[Sequence[int], TensorSpec]:
    """Shape of one observation of ``task``, and the batched spec of its actions.

    Examples:
        >>> shape, spec = spaces_of(TaskConfig(name="cartpole", env_id="CartPole-v1"))
        >>> list(shape), int(spec.space.n)
        ([4], 2)
    """
    with closing(make_env(task, 1, seed=0)) as env:
        return env.observation_spec["observation"].shape[1:], env.action_spec


def with_own_episodes(task: TaskConfig) -> TaskConfig:
    """The task with its own episodes, which end at a failure or a lost life: what experts play.

    Examples:
        >>> fixed = TaskConfig(name="cartpole", env_id="CartPole-v1", horizon="fixed")
        >>> with_own_episodes(fixed).horizon
        'own'
    """
    return replace(task, horizon="own", after_failure="reset", episode="life")


def for_scores(task: TaskConfig) -> TaskConfig:
    """The task as scores are counted: its own episodes, and whole games.

    Examples:
        >>> for_scores(TaskConfig(name="pong", env_id="ALE/Pong-v5", episode="life")).episode
        'game'
    """
    return replace(with_own_episodes(task), episode="game")


def as_recorded_task(task: TaskConfig, lives: object) -> TaskConfig:
    """The task as demonstrations are recorded: its own episodes, up to a life's end or a game's.

    Args:
        task: the task.
        lives: "first" for single lives; anything else for whole games, where there are lives.

    Examples:
        >>> as_recorded_task(TaskConfig(name="pong", env_id="ALE/Pong-v5"), "all").episode
        'game'
    """
    whole = task.family.has_lives and lives != "first"
    return for_scores(task) if whole else with_own_episodes(task)
