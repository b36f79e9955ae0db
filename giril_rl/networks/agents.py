"""Which policy and value network an environment needs."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torchrl.envs import EnvBase

from giril_rl.networks.pixel_policy import PixelActorCritic
from giril_rl.networks.policy import ActorCritic

Agent = ActorCritic | PixelActorCritic
"""PPO's policy and value network, of vectors or of pixels; both have the same methods."""


def agent_for(env: EnvBase, *, hidden: Sequence[int], normalise: bool) -> Agent:
    """An untrained agent, initialised from torch's global generator.

    Args:
        env: a batched environment; bytes as observations are taken for frames.
        hidden: hidden layers of vector networks.
        normalise: whether vectors are normalised with running statistics.

    Examples:
        >>> from giril_rl.configs import TaskConfig
        >>> from giril_rl.envs import make_env
        >>> env = make_env(TaskConfig(name="cartpole", env_id="CartPole-v1"), num_envs=1, seed=0)
        >>> type(agent_for(env, hidden=(16,), normalise=True)).__name__
        'ActorCritic'
    """
    observation = env.observation_spec["observation"]
    if observation.dtype == torch.uint8:
        return PixelActorCritic(env.action_spec.space.n, observation.shape[-3])
    return ActorCritic(observation.shape[-1], env.action_spec, hidden=hidden, normalise=normalise)
