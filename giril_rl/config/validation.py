"""Checks of config values, before anything is trained."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from functools import cache
from operator import attrgetter
from typing import Any

from giril_rl.config.imports import check_names
from giril_rl.config.knobs import Knob, default_text, knobs
from giril_rl.config.schema import (
    DemoConfig,
    ExpertConfig,
    PPOConfig,
    RunConfig,
    SACConfig,
)
from giril_rl.config.tasks import apply_task_defaults
from giril_rl.errors import UserError


def validate(config: Any) -> None:
    """Check every knob's type, bounds and choices, then how they fit together.

    Numbers must be finite; the entries of a list are checked one by one; null passes where the type
    has it. A dataclass may have checks of its own, ``check(prefix, run)``: ``prefix`` is its dotted
    key with the dot, ``run`` the whole configuration.

    Args:
        config: an instance of a recipe's ``Config`` or of any part of one.

    Raises:
        UserError: names the first key whose value is refused.

    Examples:
        >>> validate(PPOConfig(lr=0.0))
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: lr=0.0 must be greater than 0.
    """
    kind: Any = type(config)
    for knob in _knobs(kind):
        knob.check(attrgetter(knob.key)(config))
    _check_parts(config, "", config)
    if isinstance(config, RunConfig):
        _check_run(config)


@cache
def _knobs(config: Any) -> tuple[Knob, ...]:
    return tuple(knobs(config))


def _check_parts(part: Any, prefix: str, run: Any) -> None:
    if callable(getattr(part, "check", None)):
        part.check(prefix, run)
    for field in fields(part):
        value = getattr(part, field.name)
        if is_dataclass(value):
            _check_parts(value, f"{prefix}{field.name}.", run)


def _check_run(config: RunConfig) -> None:
    check_names(config.imports)
    for field in fields(config):
        _check_observations(field.name, getattr(config, field.name), config)
    images = config.task.family.observation == "image"
    if images and config.algorithm == "sac":
        raise UserError(
            f"algorithm=sac has no networks for frames, which {config.task.name} has: set "
            "algorithm=ppo."
        )
    if images and config.ppo.normalise_observations:
        raise UserError(
            f"ppo.normalise_observations=true is for vectors, and {config.task.name} has frames, "
            "which are divided by 255: leave it out."
        )


def _check_observations(name: str, part: Any, config: RunConfig) -> None:
    """Refuses a part's settings for vectors where the task has frames, and the reverse."""
    task = config.task
    images = task.family.observation == "image"
    rule = getattr(part, "normalise", None)
    if rule is not None and (rule == "pixels") != images:
        right = "pixels" if images else "standardise"
        raise UserError(
            f"{name}.normalise={rule} does not fit the observations of {task.name}: set "
            f"{name}.normalise={right}."
        )
    for layers in ("hidden", "model_hidden") if images else ():
        if hasattr(part, layers) and getattr(part, layers) != getattr(type(part)(), layers):
            raise UserError(
                f"{name}.{layers}={default_text(getattr(part, layers))} is for vectors, and "
                f"{task.name} has frames, whose layers are fixed: leave it out."
            )


def notices(config: Any) -> list[str]:
    """Sentences about settings that are rounded.

    Args:
        config: an instance of a recipe's ``Config``.

    Examples:
        >>> from giril_rl.config.schema import TaskConfig
        >>> task = TaskConfig(name="pendulum", env_id="Pendulum-v1")
        >>> notices(RunConfig(task=task, steps=15_000))
        ['steps=15000 is no multiple of a batch (16 * 125 = 2,000): 16,000 steps are taken.']
    """
    found = []
    trains = getattr(config, "trains", True)  # A random policy and a held action do not.
    if isinstance(config, RunConfig) and trains:  # Cloning has 0 steps.
        found += _rounding("steps", config.steps, config.learner)
    expert, demo = getattr(config, "expert", None), getattr(config, "demo", None)
    recorded = not isinstance(demo, DemoConfig) or demo.path is None
    needed = getattr(config, "needs_demonstration", True)
    if isinstance(expert, ExpertConfig) and expert.path is None and recorded and needed:
        key = "task.expert_steps" if expert.steps is None else "expert.steps"
        # Whatever this recipe's own settings of PPO are, the expert's are the defaults.
        ppo = apply_task_defaults(RunConfig(task=config.task)).ppo
        found += _rounding(key, expert.steps_on(config.task), ppo)
    return found


def _rounding(key: str, steps: int, learner: PPOConfig | SACConfig) -> list[str]:
    taken = learner.whole_batches(steps)
    if steps == taken:
        return []
    batch = f"{learner.num_envs} * {learner.rollout} = {learner.num_envs * learner.rollout:,}"
    return [f"{key}={steps} is no multiple of a batch ({batch}): {taken:,} steps are taken."]
