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

    The batched environment counts steps itself, for all copies at once. A time limit below another
    wrapper stays, and truncates by itself.

    Returns:
        The environment below those wrappers, and the shortest time limit that was stripped, in
        steps, if there was one.

    Examples:
        >>> import gymnasium
        >>> env, limit = without_bookkeeping(gymnasium.make("CartPole-v1"))
        >>> type(env).__name__, limit
        ('CartPoleEnv', 500)
    """
    limits = []
    # Not their subclasses, which may do more.
    while type(env) in (OrderEnforcing, PassiveEnvChecker, TimeLimit):
        limits += _own_limit(env)
        env = env.env  # type: ignore[attr-defined]
    return env, min(limits, default=None)


def shortest_limit(env: gymnasium.Env) -> int | None:
    """The shortest time limit among an environment's wrappers, in steps, if there is one.

    Examples:
        >>> env = TimeLimit(gymnasium.make("CartPole-v1"), 50)
        >>> shortest_limit(gymnasium.wrappers.RecordEpisodeStatistics(env))
        50
    """
    limits = []
    while isinstance(env, gymnasium.Wrapper):
        limits += _own_limit(env)
        env = env.env
    return min(limits, default=None)


def _own_limit(env: gymnasium.Env) -> list[int]:
    return [env._max_episode_steps] if isinstance(env, TimeLimit) else []


def action_spec(space: gymnasium.Space, num_envs: int, name: str) -> TensorSpec:
    """TorchRL's spec of the actions of ``num_envs`` environments.

    Args:
        space: one environment's action space: Discrete counted from 0, or a one-dimensional Box of
            real numbers. Where a dimension has no bound, the spec's is infinite, as TorchRL's own;
            a Box without any is Unbounded.
        num_envs: number of environments.
        name: the environment's name, for the message.

    Raises:
        UserError: for a space of another kind.

    Examples:
        >>> action_spec(gymnasium.spaces.Discrete(3), 2, "x").shape
        torch.Size([2])
        >>> box = gymnasium.spaces.Box(np.float32([-1, -np.inf]), np.float32([1, np.inf]))
        >>> action_spec(box, 1, "x").space.high
        tensor([[1., inf]])
    """
    check_action_space(space, name)
    if isinstance(space, gymnasium.spaces.Discrete):
        return Categorical(int(space.n), shape=(num_envs,), dtype=torch.int64)
    assert isinstance(space, gymnasium.spaces.Box)
    shape = (num_envs, *space.shape)
    low, high = torch.as_tensor(space.low), torch.as_tensor(space.high)
    most = torch.finfo(torch.float32).max  # Some write it for no bound.
    low = torch.where(low <= -most, -torch.inf, low)
    high = torch.where(high >= most, torch.inf, high)
    if not (low.isfinite() | high.isfinite()).any():
        return Unbounded(shape, dtype=torch.float32)
    return Bounded(low.expand(shape), high.expand(shape), shape=shape, dtype=torch.float32)


def check_action_space(space: gymnasium.Space, name: str) -> None:
    """Refuses an action space that no policy here plays in.

    Args:
        space: one environment's action space.
        name: the environment's name, for the message.

    Raises:
        UserError: for anything but Discrete counted from 0 and a one-dimensional Box of real
            numbers.

    Examples:
        >>> check_action_space(gymnasium.spaces.Discrete(3, start=1), "x")  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: x has actions of the kind Discrete(3, start=1), and actions ...
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
    """Draws those dimensions of random actions anew that lack a bound, in place.

    As :meth:`gymnasium.spaces.Box.sample` does: exponentially from a single bound, normally where
    there is none. TorchRL draws NaN and infinities there.

    Args:
        action: ``(*batch, size)``, drawn from ``spec``.
        spec: a Bounded spec.
    """
    low, high = spec.space.low, spec.space.high
    outward = torch.empty_like(action).exponential_()
    drawn = torch.where(high.isinf(), low + outward, action)
    drawn = torch.where(low.isinf(), high - outward, drawn)
    neither = low.isinf() & high.isinf()
    action.copy_(torch.where(neither, torch.randn_like(action), drawn))
