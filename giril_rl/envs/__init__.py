"""From a task's name to a batched TorchRL environment."""

from giril_rl.envs.atari import AtariEnv
from giril_rl.envs.atari_gym import AtariGymEnv
from giril_rl.envs.batched import BatchedEnv
from giril_rl.envs.fixed import FixedHorizonEnv
from giril_rl.envs.make import for_scores, gym_factory, make_env, with_own_episodes
from giril_rl.envs.vector import GymVectorEnv

__all__ = [
    "AtariEnv",
    "AtariGymEnv",
    "BatchedEnv",
    "FixedHorizonEnv",
    "GymVectorEnv",
    "for_scores",
    "gym_factory",
    "make_env",
    "with_own_episodes",
]
