"""Settings that a task or its family changes in every recipe."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import is_dataclass
from functools import cache
from typing import Any

import yaml

from giril_rl.config.families import family_of
from giril_rl.config.leaves import flat
from giril_rl.config.recipe_files import shipped_conf


@cache
def _shipped(name: str) -> dict[str, Any]:
    return yaml.safe_load((shipped_conf() / "kind" / f"{name}.yaml").read_text(encoding="utf-8"))


def task_defaults(env_id: str, chosen: Collection[str] = ()) -> dict[str, Any]:
    """What a task's family changes, by dotted key, less what somebody chose.

    Args:
        env_id: the task's Gymnasium id.
        chosen: dotted keys to leave out, also all those below them.

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
    """Gives a recipe's ``Config`` the values of :func:`task_defaults`.

    Keys that the recipe does not have are passed over, and so are those that somebody chose.

    Args:
        config: an instance of a recipe's ``Config``, or of any part of one that has a task; changed
            in place.
        chosen: see :func:`task_defaults`.

    Returns:
        ``config``.

    Examples:
        >>> from giril_rl.config.schema import RunConfig, TaskConfig
        >>> config = RunConfig(task=TaskConfig(name="pong", env_id="ALE/Pong-v5"))
        >>> config = apply_task_defaults(config, chosen=["ppo.rollout"])
        >>> config.ppo.num_envs, config.ppo.rollout
        (8, 125)
    """
    changes = task_defaults(config.task.env_id, chosen)
    if config.task.demonstration is not None and not _asks_for_a_player(chosen):
        changes["demo.path"] = config.task.demonstration
    for key, value in changes.items():
        *parts, name = key.split(".")
        part = config
        for step in parts:
            part = getattr(part, step, None)
            if not is_dataclass(part):
                break
        if is_dataclass(part) and hasattr(part, name):
            setattr(part, name, value)
    return config


def _asks_for_a_player(chosen: Collection[str]) -> bool:
    """Whether somebody chose the demonstration, the expert who gives it, or how it is recorded."""
    return any(
        key.startswith("expert.") or (key.startswith("demo.") and key != "demo.subsample")
        for key in chosen
    )
