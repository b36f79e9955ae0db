"""From a task's name to a batched TorchRL environment."""

from giril_rl.envs.fixed import FixedHorizonEnv
from giril_rl.envs.make import gym_factory, make_env, with_own_episodes
from giril_rl.envs.vector import GymVectorEnv

__all__ = ["FixedHorizonEnv", "GymVectorEnv", "gym_factory", "make_env", "with_own_episodes"]
