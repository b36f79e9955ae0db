"""Gymnasium environments from anybody: their spaces, wrappers and returned values, checked.

numpy would broadcast an observation of another shape, and turn a reward of None into NaN.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import sys
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit
from torchrl.data import Bounded, Categorical, TensorSpec, Unbounded

from giril_rl.config.nearest import did_you_mean
from giril_rl.config.schema import split_id
from giril_rl.errors import UserError


def registered_spec(env_id: str) -> gymnasium.envs.registration.EnvSpec:
    """What Gymnasium has registered for an id, or for ``MODULE:ID`` of an imported module.

    Raises:
        UserError: if the id is unknown, with the nearest known one, or its module not imported.
    """
    module, name = split_id(env_id)
    if module is not None and module not in sys.modules:
        raise UserError(
            f"task.env_id={env_id} is not a Gymnasium id here: its module {module} is not "
            f"imported; name it with imports=[{module}] or --import {module}, or import it."
        )
    try:
        return gymnasium.spec(name)
    except gymnasium.error.Error:
        who = "is not a Gymnasium id"
        otherwise = "; check its name, or name the module that registers it: MODULE:ID."
        if module is not None:
            who, otherwise = f"{who} that {module} registers", ": check its name."
        hint = did_you_mean(name, gymnasium.registry) or otherwise
        raise UserError(f"task.env_id={env_id} {who}{hint}") from None


def import_package(package: str, extra: str | None = None) -> None:
    """Imports a package that registers environments."""
    try:
        importlib.import_module(package)
    except ImportError:
        command = f'pip install "giril-rl[{extra}]"' if extra else f"pip install {package}"
        raise UserError(f"this task needs {package}, which is not installed: {command}.") from None


def env_name(env: gymnasium.Env) -> str:
    """An environment's name in messages: its id, or its class."""
    return env.spec.id if env.spec is not None else type(env.unwrapped).__name__


def check_reset(env: gymnasium.Env, returned: Any) -> tuple[Any, dict[str, Any]]:
    """Passes on what ``reset`` returned: an observation of the space's shape, and a dict."""
    if not isinstance(returned, tuple) or len(returned) != 2:
        raise UserError(
            f"{env_name(env)}.reset returns no pair of observation and info: bring it to "
            "Gymnasium's present API."
        )
    _check_shape(env, returned[0])
    return returned


def check_step(env: gymnasium.Env, returned: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
    """Passes on what ``step`` returned, if it is what Gymnasium's API says.

    Raises:
        UserError: unless it is an observation of the space's shape, a number, two flags and a dict.

    Examples:
        >>> env = gymnasium.make("CartPole-v1")
        >>> check_step(env, (np.zeros(4), None, False, False, {}))
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: CartPole-v1.step returns None as reward: it must be a number.
    """
    if not isinstance(returned, tuple) or len(returned) != 5:
        raise UserError(
            f"{env_name(env)}.step does not return observation, reward, terminated, truncated and "
            "info: bring it to Gymnasium's present API."
        )
    _check_shape(env, returned[0])
    for name, value, kinds, wanted in (
        ("reward", returned[1], "fiub", "a number"),
        ("terminated", returned[2], "biu", "True or False"),
        ("truncated", returned[3], "biu", "True or False"),
    ):
        array = np.asarray(value)
        if array.dtype.kind not in kinds or array.size != 1:
            raise UserError(
                f"{env_name(env)}.step returns {value!r} as {name}: it must be {wanted}."
            )
    return returned


def _check_shape(env: gymnasium.Env, observation: Any) -> None:
    space = env.observation_space
    if isinstance(space, gymnasium.spaces.Box) and np.shape(observation) != space.shape:
        raise UserError(
            f"{env_name(env)} shows an observation of shape {list(np.shape(observation))}, and its "
            f"observation_space is of shape {list(space.shape)}: make them agree."
        )


def without_bookkeeping(env: gymnasium.Env) -> tuple[gymnasium.Env, int | None]:
    """Strips Gymnasium's outermost order, space and time checks.

    The batched environment counts the steps of all copies at once. A time limit below another
    wrapper stays, and truncates by itself.

    Returns:
        The environment below those wrappers, and the shortest time limit stripped, in steps.
    """
    limits = []
    # Exact types only: a subclass may do more.
    while type(env) in (OrderEnforcing, PassiveEnvChecker, TimeLimit):
        limits += _own_limit(env)
        env = env.env  # type: ignore[attr-defined]
    return env, min(limits, default=None)


def shortest_limit(env: gymnasium.Env) -> int | None:
    """The shortest time limit among an environment's wrappers, in steps, if there is one."""
    limits = []
    while isinstance(env, gymnasium.Wrapper):
        limits += _own_limit(env)
        env = env.env
    return min(limits, default=None)


def _own_limit(env: gymnasium.Env) -> list[int]:
    return [env._max_episode_steps] if isinstance(env, TimeLimit) else []


def check_copies(envs: list[gymnasium.Env]) -> None:
    """Refuses environments that share a simulator, or are not of one kind."""
    name = env_name(envs[0])
    if len({id(env.unwrapped) for env in envs}) < len(envs):
        raise UserError(
            f"make_fn returned the same {name} several times, which cannot play {len(envs)} "
            "episodes at once: make a new environment at each call."
        )
    kinds = {
        "observation_space": lambda env: (env.observation_space.shape, env.observation_space.dtype),
        "action_space": lambda env: env.action_space,
        "time limit": shortest_limit,
    }
    for what, kind in kinds.items():
        if any(kind(env) != kind(envs[0]) for env in envs):
            raise UserError(
                f"make_fn returned environments that differ in their {what}: make equal ones."
            )


def action_spec(space: gymnasium.Space, num_envs: int, name: str) -> TensorSpec:
    """TorchRL's spec of the actions of ``num_envs`` environments; a missing bound is infinite."""
    check_action_space(space, name)
    if isinstance(space, gymnasium.spaces.Discrete):
        return Categorical(int(space.n), shape=(num_envs,), dtype=torch.int64)
    assert isinstance(space, gymnasium.spaces.Box)
    shape = (num_envs, *space.shape)
    low, high = torch.as_tensor(space.low), torch.as_tensor(space.high)
    most = torch.finfo(torch.float32).max  # Some environments write it for "no bound".
    low = torch.where(low <= -most, -torch.inf, low)
    high = torch.where(high >= most, torch.inf, high)
    if not (low.isfinite() | high.isfinite()).any():
        return Unbounded(shape, dtype=torch.float32)
    return Bounded(low.expand(shape), high.expand(shape), shape=shape, dtype=torch.float32)


def check_action_space(space: gymnasium.Space, name: str) -> None:
    """Refuses an action space that no policy here plays in.

    Raises:
        UserError: for anything but Discrete counted from 0 and a one-dimensional Box of reals.
    """
    kind = f"{name} has actions of the kind {space}"
    if isinstance(space, gymnasium.spaces.Discrete):
        if space.start != 0:
            raise UserError(
                f"{kind}, and actions are counted from 0 here: shift them in a wrapper such as "
                "gymnasium.wrappers.TransformAction."
            )
    elif not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
        raise UserError(f"{kind}: choose a task with Discrete or one-dimensional Box actions.")
    elif not np.issubdtype(space.dtype, np.floating):
        raise UserError(
            f"{kind}, whole numbers, and a policy plays real ones in a Box: give the task a "
            "float32 Box and round in a wrapper such as gymnasium.wrappers.TransformAction."
        )


def fill_unbounded(action: torch.Tensor, spec: TensorSpec) -> None:
    """Redraws, in place, the dimensions of random actions that lack a bound.

    As :meth:`gymnasium.spaces.Box.sample` does: exponentially from a single bound, normally where
    there is none. TorchRL draws NaN and infinities there.
    """
    low, high = spec.space.low, spec.space.high
    outward = torch.empty_like(action).exponential_()
    drawn = torch.where(high.isinf(), low + outward, action)
    drawn = torch.where(low.isinf(), high - outward, drawn)
    neither = low.isinf() & high.isinf()
    action.copy_(torch.where(neither, torch.randn_like(action), drawn))


@contextlib.contextmanager
def silent_stdout(*, stderr: bool = False) -> Iterator[None]:
    """Drops what C code prints on standard output, as pybullet does whenever it connects.

    Args:
        stderr: also drop standard error, where pybullet prints when it is imported.
    """
    streams = [sys.stdout, sys.stderr] if stderr else [sys.stdout]
    for stream in streams:
        stream.flush()
    saved = [os.dup(descriptor) for descriptor in range(1, len(streams) + 1)]
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        for descriptor in range(1, len(streams) + 1):
            os.dup2(null, descriptor)
        yield
    finally:
        for descriptor, (stream, kept) in enumerate(zip(streams, saved, strict=True), 1):
            stream.flush()
            os.dup2(kept, descriptor)
            os.close(kept)
        os.close(null)
