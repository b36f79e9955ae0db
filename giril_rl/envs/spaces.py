"""What a Gymnasium environment's spaces and wrappers are to the batched environment."""

from __future__ import annotations

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit
from torchrl.data import Bounded, Categorical, TensorSpec, Unbounded

from giril_rl.errors import UserError


def without_bookkeeping(env: gymnasium.Env) -> tuple[gymnasium.Env, int | None]:
    """Strips Gymnasium's outermost order, space and time checks.

    The batched environment counts steps itself, for all copies at once.

    Returns:
        The environment below those wrappers, and the time limit in steps if there was one.

    Examples:
        >>> import gymnasium
        >>> env, limit = without_bookkeeping(gymnasium.make("CartPole-v1"))
        >>> type(env).__name__, limit
        ('CartPoleEnv', 500)
    """
    limit = None
    while isinstance(env, (OrderEnforcing, PassiveEnvChecker, TimeLimit)):
        if isinstance(env, TimeLimit):
            limit = env._max_episode_steps
        env = env.env
    return env, limit


def action_spec(space: gymnasium.Space, num_envs: int, name: str) -> TensorSpec:
    """TorchRL's spec of the actions of ``num_envs`` environments.

    Args:
        space: one environment's action space, Discrete or one-dimensional Box.
        num_envs: number of environments.
        name: the environment's name, for the message.

    Raises:
        UserError: for a space of another kind.

    Examples:
        >>> action_spec(gymnasium.spaces.Discrete(3), 2, "x").shape
        torch.Size([2])
    """
    if isinstance(space, gymnasium.spaces.Discrete) and space.start == 0:
        return Categorical(int(space.n), shape=(num_envs,), dtype=torch.int64)
    if isinstance(space, gymnasium.spaces.Box) and len(space.shape) == 1:
        shape = (num_envs, *space.shape)
        if not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
            return Unbounded(shape, dtype=torch.float32)
        low, high = torch.as_tensor(space.low), torch.as_tensor(space.high)
        return Bounded(low.expand(shape), high.expand(shape), shape=shape, dtype=torch.float32)
    raise UserError(
        f"{name} has actions of the kind {space}: choose a task with Discrete or one-dimensional "
        "Box actions."
    )
