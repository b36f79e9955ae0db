"""The task that a demonstration is of: its spaces, and whether they fit."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

from torchrl.data import TensorSpec

from giril_rl.config.schema import TaskConfig, split_id
from giril_rl.demos.check import check_demonstration
from giril_rl.demos.demonstration import Demonstration
from giril_rl.envs import make_env, with_own_episodes
from giril_rl.errors import UserError


def spaces_of(task: TaskConfig) -> tuple[Sequence[int], TensorSpec]:
    """Shape of an observation of ``task``, and the spec of its actions.

    Examples:
        >>> from giril_rl.config.tasks import named_task
        >>> shape, spec = spaces_of(named_task(None, "CartPole-v1"))
        >>> list(shape), int(spec.space.n)
        ([4], 2)
    """
    env = make_env(task, 1, seed=0)
    shape, spec = env.observation_spec["observation"].shape[1:], env.action_spec
    env.close()
    return shape, spec


def check_environment(demo: Demonstration, task: TaskConfig) -> None:
    """Refuse a demonstration whose card says that it is of another environment.

    All games have the same observations, and many the same actions, which are not called alike.
    Versions of one environment pass.

    Raises:
        UserError: naming both.
    """
    recorded = demo.card.get("env_id")
    if isinstance(recorded, str) and _named(recorded) != _named(task.env_id):
        raise UserError(
            f"the demonstration is of {recorded} and not of {task.env_id}: use one of this task."
        )


def _named(env_id: str) -> str:
    return re.sub(r"-v\d+$", "", split_id(env_id)[1])


def check_for_task(demo: Demonstration, task: TaskConfig) -> None:
    """:func:`check_demonstration` with the spaces of ``task``.

    Raises:
        UserError: as :func:`check_demonstration` and :func:`spaces_of`.
    """
    check_demonstration(demo, *spaces_of(task))


def as_recorded_task(task: TaskConfig, lives: object) -> TaskConfig:
    """The task as ``lives`` of a demonstration is recorded: "first", or whole games.

    Examples:
        >>> from giril_rl.config.tasks import named_task
        >>> as_recorded_task(named_task("breakout", None), "all").episode
        'game'
    """
    task = with_own_episodes(task)
    return replace(task, episode="life" if lives == "first" or not task.is_atari else "game")
