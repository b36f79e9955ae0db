"""What a transition is worth: learned reward modules, how they are trained, and a control."""

from giril_rl.rewards.actions import ActionEncoder
from giril_rl.rewards.constant import ConstantReward
from giril_rl.rewards.generative import (
    GenerativeReward,
    Prior,
    blend_action,
    reconstruction_error,
)
from giril_rl.rewards.generative_loss import (
    GenerativeRewardLoss,
    action_term,
    gaussian_kl,
)
from giril_rl.rewards.scaler import ObservationScaler, ScalingRule

__all__ = [
    "ActionEncoder",
    "ConstantReward",
    "GenerativeReward",
    "GenerativeRewardLoss",
    "ObservationScaler",
    "Prior",
    "ScalingRule",
    "action_term",
    "blend_action",
    "gaussian_kl",
    "reconstruction_error",
]
