"""Tasks: those shipped by name, and the settings that a task changes in every recipe."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import is_dataclass
from functools import cache
from typing import Any

import yaml
from omegaconf import OmegaConf

from giril_rl.config.families import family_of
from giril_rl.config.knobs import flat
from giril_rl.config.nearest import did_you_mean
from giril_rl.config.recipes import shipped_conf
from giril_rl.config.schema import TaskConfig
from giril_rl.errors import UserError

_OPEN = ("atari", "gymnasium")  # An id completes these.


def named_task(name: str | None, env_id: str | None, title: str | None = None) -> TaskConfig:
    """The shipped task of that name, or the task of a Gymnasium id.

    Args:
        name: as in ``task=breakout``.
        env_id: as in ``task.env_id=Pendulum-v1``, instead of ``name``.
        title: what tables call the task of an id; None takes the id itself.

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
    known = sorted(files.keys() - _OPEN)
    if name not in known:
        hint = did_you_mean(str(name), known) or f": choose one of {', '.join(known)}."
        raise UserError(f"--task {name} is not a task{hint}")
    values = OmegaConf.merge(OmegaConf.structured(TaskConfig), OmegaConf.load(files[name]))
    built = OmegaConf.to_object(values)
    assert isinstance(built, TaskConfig)
    return built


@cache
def _shipped(name: str) -> dict[str, Any]:
    return yaml.safe_load((shipped_conf() / "kind" / f"{name}.yaml").read_text(encoding="utf-8"))


def task_defaults(env_id: str, chosen: Collection[str] = ()) -> dict[str, Any]:
    """The settings, by dotted key, that the family of a task changes and nobody chose.

    Args:
        env_id: the task's Gymnasium id.
        chosen: dotted keys to leave out, with all those below them.

    Examples:
        >>> task_defaults("ALE/Pong-v5")["ppo.num_envs"], task_defaults("Pendulum-v1")
        (8, {})
    """
    settings = family_of(env_id).settings or {}
    if isinstance(settings, str):
        settings = _shipped(settings)
    return {
        key: value
        for key, value in flat(settings).items()
        if not any(key == one or key.startswith(f"{one}.") for one in chosen)
    }


def apply_task_defaults(config: Any, chosen: Collection[str] = ()) -> Any:
    """Sets the values of :func:`task_defaults` in a recipe's ``Config``, and returns it.

    The task's own demonstration is one of them, unless somebody chose the demonstration, its expert
    or how it is recorded. Keys that the recipe does not have are passed over.

    Args:
        config: an instance of a recipe's ``Config``, or any part that has a task; changed in place.
        chosen: see :func:`task_defaults`.

    Examples:
        >>> from giril_rl.config.schema import RunConfig, TaskConfig
        >>> config = RunConfig(task=TaskConfig(name="pong", env_id="ALE/Pong-v5"))
        >>> config = apply_task_defaults(config, chosen=["ppo.rollout"])
        >>> config.ppo.num_envs, config.ppo.rollout
        (8, 125)
    """
    changes = task_defaults(config.task.env_id, chosen)
    if config.task.demonstration is not None and not any(map(chooses_demonstration, chosen)):
        changes["demo.path"] = config.task.demonstration
    for key, value in changes.items():
        *parts, name = key.split(".")
        part = config
        for step in parts:
            part = getattr(part, step, None)
        if is_dataclass(part) and hasattr(part, name):
            setattr(part, name, value)
    return config


def chooses_demonstration(key: str) -> bool:
    """Whether a setting says which demonstration it is, rather than how much of it is used.

    Examples:
        >>> chooses_demonstration("expert.seed"), chooses_demonstration("demo.first")
        (True, False)
    """
    recorded = key.startswith("demo.") and key not in ("demo.subsample", "demo.first")
    return recorded or key.startswith("expert.")
