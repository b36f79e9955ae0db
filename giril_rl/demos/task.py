"""The task that a demonstration is of, by the name that a recipe takes or by a Gymnasium id."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

from omegaconf import OmegaConf
from torchrl.data import TensorSpec

from giril_rl.config.nearest import did_you_mean
from giril_rl.config.recipe_files import shipped_conf
from giril_rl.config.schema import TaskConfig, split_id
from giril_rl.demos.check import check_demonstration
from giril_rl.demos.demonstration import Demonstration
from giril_rl.envs import make_env, with_own_episodes
from giril_rl.errors import UserError

_OPEN = ("atari", "gymnasium")  # These are completed by an id.


def named_task(name: str | None, env_id: str | None, title: str | None = None) -> TaskConfig:
    """The task ``name`` of the shipped ones, or that of a Gymnasium id.

    Args:
        name: as in ``task=breakout``.
        env_id: as in ``task.env_id=Pendulum-v1``, instead of ``name``.
        title: what tables call the task of an id; the id itself if None.

    Raises:
        UserError: unless exactly one of ``name`` and ``env_id`` is given, or for an unknown name.

    Examples:
        >>> named_task("breakout", None).env_id, named_task(None, "Pendulum-v1").name
        ('ALE/Breakout-v5', 'Pendulum-v1')
    """
    if (name is None) == (env_id is None):
        raise UserError("say which task it is of: give either --task NAME or --env-id ID.")
    if env_id is not None:
        return TaskConfig(name=title or env_id, env_id=env_id)
    files = {file.stem: file for file in (shipped_conf() / "task").glob("*.yaml")}
    files = {stem: file for stem, file in files.items() if stem not in _OPEN}
    if name not in files:
        hint = did_you_mean(str(name), files) or f": choose one of {', '.join(sorted(files))}."
        raise UserError(f"--task {name} is not a task{hint}")
    built = OmegaConf.to_object(
        OmegaConf.merge(OmegaConf.structured(TaskConfig), OmegaConf.load(files[name]))
    )
    assert isinstance(built, TaskConfig)
    return built


def spaces_of(task: TaskConfig) -> tuple[Sequence[int], TensorSpec]:
    """Shape of an observation of ``task``, and the spec of its actions.

    Examples:
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
        >>> as_recorded_task(named_task("breakout", None), "all").episode
        'game'
    """
    task = with_own_episodes(task)
    return replace(task, episode="life" if lives == "first" or not task.is_atari else "game")
