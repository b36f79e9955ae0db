"""From a task's name to a batched TorchRL environment."""

from giril_rl.config.families import TaskFamily
from giril_rl.envs.atari import AtariEnv
from giril_rl.envs.atari_family import AtariGymEnv
from giril_rl.envs.batched import BatchedEnv
from giril_rl.envs.families import (
    as_recorded_task,
    for_scores,
    gym_factory,
    make_env,
    observation_kind,
    register_family,
    spaces_of,
    with_own_episodes,
)
from giril_rl.envs.fixed import FixedHorizonEnv
from giril_rl.envs.vector import GymImageEnv, GymVectorEnv

__all__ = [
    "AtariEnv",
    "AtariGymEnv",
    "BatchedEnv",
    "FixedHorizonEnv",
    "GymImageEnv",
    "GymVectorEnv",
    "TaskFamily",
    "as_recorded_task",
    "for_scores",
    "gym_factory",
    "make_env",
    "observation_kind",
    "register_family",
    "spaces_of",
    "with_own_episodes",
]
