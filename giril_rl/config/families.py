"""Families of tasks: what settings and reports must know of an environment without making it.

:mod:`giril_rl.envs.families` makes the environments. Nothing heavy is imported here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

Observation = Literal["vector", "image"]


@dataclass(frozen=True, eq=False)
class TaskFamily:
    """What the tasks of one family have in common.

    Attributes:
        name: the family's name. ``task=NAME`` completes a bare id where such a file is shipped.
        prefix: what the Gymnasium ids of the family begin with.
        observation: "vector", float32 ``(size,)``, or "image", uint8 ``(channels, height, width)``.
        has_lives: whether ``task.episode`` chooses between a life and a whole game. Such an
            environment has what :class:`giril_rl.envs.AtariEnv` has: ``lives``, ``meanings`` and
            ``("next", "game_over")``.
        fixed_horizon: whether ``task.horizon=fixed`` can hide failures.
        settings: what recipes set differently for these tasks, by key; or the name of a file in
            ``recipes/conf/kind``.

    Examples:
        >>> TaskFamily("boxes", "Boxes/", observation="image").matches("my_envs:Boxes/Push-v0")
        True
    """

    name: str
    prefix: str
    observation: Observation = "vector"
    has_lives: bool = False
    fixed_horizon: bool = False
    settings: str | Mapping[str, Any] | None = None

    def matches(self, env_id: str) -> bool:
        """Whether an id, with or without the module that registers it, is of this family."""
        return env_id.rpartition(":")[2].startswith(self.prefix)


ATARI = TaskFamily("atari", "ALE/", observation="image", has_lives=True, settings="atari")
GYMNASIUM = TaskFamily("gymnasium", "", fixed_horizon=True)

_families = [ATARI, GYMNASIUM]


def register_task_family(family: TaskFamily) -> None:
    """Adds a family, which goes before those that are there; it replaces one of its name."""
    _families[:] = [family, *(other for other in _families if other.name != family.name)]


def family_of(env_id: str) -> TaskFamily:
    """The family of a Gymnasium id: the last registered one that matches.

    Examples:
        >>> family_of("ALE/Pong-v5").observation, family_of("Pendulum-v1").observation
        ('image', 'vector')
    """
    return next(family for family in _families if family.matches(env_id))
