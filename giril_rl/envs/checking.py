"""What a Gymnasium environment returns, held to its spaces before it is copied into a batch.

numpy would broadcast an observation of another shape, and take a reward of None for NaN.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from giril_rl.errors import UserError


def env_name(env: gymnasium.Env) -> str:
    """What messages call an environment: its id, or its class.

    Examples:
        >>> env_name(gymnasium.make("CartPole-v1"))
        'CartPole-v1'
    """
    return env.spec.id if env.spec is not None else type(env.unwrapped).__name__


def check_reset(env: gymnasium.Env, returned: Any) -> tuple[Any, dict[str, Any]]:
    """Refuses what a reset must not return.

    Args:
        env: the environment.
        returned: what its ``reset`` returned.

    Returns:
        The same.

    Raises:
        UserError: unless it is an observation of the space's shape and a dict.
    """
    if not isinstance(returned, tuple) or len(returned) != 2:
        raise UserError(
            f"{env_name(env)}.reset returns no pair of observation and info: bring it to "
            "Gymnasium's present API."
        )
    _check_shape(env, returned[0])
    return returned


def check_step(env: gymnasium.Env, returned: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
    """Refuses what a step must not return.

    Args:
        env: the environment.
        returned: what its ``step`` returned.

    Returns:
        The same.

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
