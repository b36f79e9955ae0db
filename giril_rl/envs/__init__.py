"""From a task's name to a batched TorchRL environment."""

from giril_rl.envs.make import gym_factory, make_env
from giril_rl.envs.vector import GymVectorEnv

__all__ = ["GymVectorEnv", "gym_factory", "make_env"]
