"""Values of the right type that are wrong all the same, refused before anything is trained."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any

from giril_rl.config.imports import check_names
from giril_rl.config.leaves import leaves
from giril_rl.config.schema import (
    MOST,
    BCConfig,
    DemoConfig,
    ExpertConfig,
    ExpertRunConfig,
    PPOConfig,
    RunConfig,
    TaskConfig,
)
from giril_rl.config.task_defaults import apply_task_defaults
from giril_rl.errors import UserError


def _show(value: Any) -> str:
    return "null" if value is None else str(value).replace(" ", "")


def _range(metadata: Any) -> str:
    low, high = metadata.get("low"), metadata.get("high")
    if high is None:
        return f"{'above' if metadata['low_open'] else 'at least'} {low:g}"
    if low is None:
        return f"{'below' if metadata['high_open'] else 'at most'} {high:g}"
    left = "(" if metadata["low_open"] else "["
    right = ")" if metadata["high_open"] else "]"
    return f"in {left}{low:g}, {high:g}{right}"


def _inside(number: float, metadata: Any) -> bool:
    low, high = metadata.get("low"), metadata.get("high")
    if low is not None and (number < low or (number == low and metadata["low_open"])):
        return False
    return high is None or number < high or (number == high and not metadata["high_open"])


def _check_ppo(key: str, ppo: PPOConfig) -> None:
    batch = ppo.num_envs * ppo.rollout
    if batch % ppo.minibatch:
        raise UserError(
            f"{key}.minibatch={ppo.minibatch} does not divide {key}.num_envs * {key}.rollout "
            f"= {ppo.num_envs} * {ppo.rollout} = {batch}: choose one that does."
        )


def _check_task(key: str, task: TaskConfig) -> None:
    if task.horizon != "own" and not task.family.fixed_horizon:
        raise UserError(
            f"{key}.horizon={task.horizon} is for vector tasks: leave {key}.horizon=own."
        )
    if task.episode != "life" and not task.family.has_lives:
        raise UserError(
            f"{key}.episode={task.episode} is for games, whose lives end episodes: leave "
            f"{key}.episode=life."
        )
    if task.after_failure != "reset" and task.horizon == "own":
        raise UserError(
            f"{key}.after_failure={task.after_failure} means nothing where a failure ends the "
            f"episode: add {key}.horizon=fixed."
        )


def _check_expert_run(config: ExpertRunConfig) -> None:
    if config.task.horizon != "own":
        raise UserError(
            f"task.horizon={config.task.horizon}: an expert plays the task as it is; leave "
            "task.horizon=own."
        )


def _check_cloning(config: Any, cloning: BCConfig) -> None:
    if config.steps:
        raise UserError(
            f"steps={config.steps}: cloning takes no environment steps; leave steps=0, bc.steps is "
            "the number of gradient steps."
        )
    if cloning.stop == "held_out" and config.demo.subsample == 1:
        raise UserError(
            "bc.stop=held_out needs transitions to hold out and demo.subsample=1 leaves none: "
            "set demo.subsample to at least 2, or bc.stop=fixed."
        )


def _check_normalise(config: Any) -> None:
    """Frames have one rule of normalisation, and it is for nothing else."""
    images = config.task.family.observation == "image"
    for part in fields(config):
        rule = getattr(getattr(config, part.name), "normalise", None)
        if rule is not None and (rule == "pixels") != images:
            right = "pixels" if images else "standardise"
            raise UserError(
                f"{part.name}.normalise={rule} does not fit the observations of "
                f"{config.task.name}: set {part.name}.normalise={right}."
            )
    if images and config.ppo.normalise_observations:
        raise UserError(
            f"ppo.normalise_observations=true is for vectors, and {config.task.name} has frames, "
            "which are divided by 255: leave it out."
        )


def _check_layers(config: RunConfig) -> None:
    """The networks of frames are the paper's: what would change those of vectors has no effect."""
    for part in fields(config):
        value = getattr(config, part.name)
        for name in ("hidden", "model_hidden"):
            if hasattr(value, name) and getattr(value, name) != getattr(type(value)(), name):
                raise UserError(
                    f"{part.name}.{name}={_show(getattr(value, name))} is for vectors, and "
                    f"{config.task.name} has frames, whose layers are fixed: leave it out."
                )


def _check_run(config: Any) -> None:
    if isinstance(config, RunConfig):
        check_names(config.imports)
        _check_normalise(config)
        if config.task.family.observation == "image":
            _check_layers(config)
    if isinstance(config, ExpertRunConfig):
        _check_expert_run(config)
    cloning = getattr(config, "bc", None)
    if isinstance(cloning, BCConfig):
        _check_cloning(config, cloning)


def _check_demo(key: str, demo: DemoConfig) -> None:
    if (demo.length is None) == (demo.episodes is None):
        raise UserError(
            f"{key}.length={_show(demo.length)} and {key}.episodes={_show(demo.episodes)}: "
            "give exactly one of them and set the other to null."
        )
    if demo.length is not None and demo.subsample > demo.length:
        raise UserError(
            f"{key}.subsample={demo.subsample} leaves nothing of {key}.length={demo.length}: "
            "choose a smaller one."
        )


_PART_CHECKS: dict[type, Callable[[str, Any], None]] = {
    PPOConfig: _check_ppo,
    TaskConfig: _check_task,
    DemoConfig: _check_demo,
}


def _check_parts(config: Any, prefix: str = "") -> None:
    for part in fields(config):
        value = getattr(config, part.name)
        if is_dataclass(value):
            key = f"{prefix}{part.name}"
            for kind, check in _PART_CHECKS.items():
                if isinstance(value, kind):
                    check(key, value)
            _check_parts(value, f"{key}.")


def validate(config: Any) -> None:
    """Check every knob's choices and bounds, then what single knobs cannot tell.

    Numbers must be finite; a list's entries are checked one by one; null passes where the type
    has it.

    Args:
        config: an instance of a recipe's ``Config`` or of any part of one.

    Raises:
        UserError: names the first key whose value is refused.

    Examples:
        >>> validate(PPOConfig(gamma=1.5))
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: gamma=1.5 must be in [0, 1].
    """
    for leaf in leaves(type(config)):
        value = config
        for name in leaf.key.split("."):
            value = getattr(value, name)
        if value is None:
            continue
        if leaf.choices and value not in leaf.choices:
            allowed = ", ".join(leaf.choices) + (", null" if leaf.optional else "")
            raise UserError(f"{leaf.key}={_show(value)}: choose one of {allowed}.")
        for number in value if isinstance(value, list) else [value]:
            if isinstance(number, (str, bool)):
                continue
            if isinstance(number, int) and abs(number) > MOST:
                shown = _show(value) if len(_show(value)) < 100 else "..."
                raise UserError(f"{leaf.key}={shown}: at most {MOST} is possible.")
            if not math.isfinite(number):
                raise UserError(f"{leaf.key}={_show(value)}: a finite number is needed.")
            if not _inside(number, leaf.metadata):
                each = ": each entry" if isinstance(value, list) else ""
                words = f"{each} must be {_range(leaf.metadata)}"
                raise UserError(f"{leaf.key}={_show(value)}{words}.")
    _check_parts(config)
    _check_run(config)


def notices(config: Any) -> list[str]:
    """What a user should know of settings that are taken in another way than they are written.

    Args:
        config: an instance of a recipe's ``Config``.

    Returns:
        Sentences.

    Examples:
        >>> from giril_rl.config.schema import TaskConfig
        >>> task = TaskConfig(name="pendulum", env_id="Pendulum-v1")
        >>> notices(RunConfig(task=task, steps=15_000))
        ['steps=15000 is no multiple of a batch (16 * 125 = 2,000): 16,000 steps are taken.']
    """
    found = []
    trains = getattr(config, "trains", True)
    if isinstance(config, RunConfig) and trains:  # Of cloning, steps are 0.
        found += _rounding("steps", config.steps, config.ppo)
    expert, demo = getattr(config, "expert", None), getattr(config, "demo", None)
    recorded = not isinstance(demo, DemoConfig) or demo.path is None
    needed = getattr(config, "needs_demonstration", True)
    if isinstance(expert, ExpertConfig) and expert.path is None and recorded and needed:
        # The expert that another recipe trains has the settings of PPO that are the default.
        key = "task.expert_steps" if expert.steps is None else "expert.steps"
        ppo = apply_task_defaults(ExpertRunConfig(task=config.task)).ppo
        found += _rounding(key, expert.steps_on(config.task), ppo)
    return found


def _rounding(key: str, steps: int, ppo: PPOConfig) -> list[str]:
    taken = ppo.whole_batches(steps)
    if steps == taken:
        return []
    batch = f"{ppo.num_envs} * {ppo.rollout} = {ppo.num_envs * ppo.rollout:,}"
    return [f"{key}={steps} is no multiple of a batch ({batch}): {taken:,} steps are taken."]
