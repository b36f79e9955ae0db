"""What each method is made of."""

from giril_rl.methods.control_rewards import baseline_policy, check_baseline, control_reward
from giril_rl.methods.reward_models import (
    bottleneck_reward,
    copy_reward,
    curiosity_reward,
    discriminator_reward,
    generative_reward,
)

__all__ = [
    "baseline_policy",
    "bottleneck_reward",
    "check_baseline",
    "control_reward",
    "copy_reward",
    "curiosity_reward",
    "discriminator_reward",
    "generative_reward",
]
