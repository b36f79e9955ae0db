"""What a transition is worth: learned reward modules, how they are trained, and controls."""

from giril_rl.rewards.actions import ActionEncoder
from giril_rl.rewards.adversarial import (
    RewardForm,
    adversarial_reward,
    discriminator_loss,
    gradient_penalty,
)
from giril_rl.rewards.affine import AffineReward
from giril_rl.rewards.bottleneck import BottleneckReward
from giril_rl.rewards.bottleneck_loss import BottleneckLoss
from giril_rl.rewards.constant import ConstantReward
from giril_rl.rewards.copy import CopyReward
from giril_rl.rewards.curiosity import CuriosityReward, feature_error
from giril_rl.rewards.curiosity_loss import CuriosityRewardLoss, FeatureTraining
from giril_rl.rewards.discriminator import DiscriminatorReward, DiscriminatorScaling
from giril_rl.rewards.discriminator_loss import DiscriminatorLoss
from giril_rl.rewards.equations import blend_action, reconstruction_error
from giril_rl.rewards.factored import factored_error
from giril_rl.rewards.fitting import fit
from giril_rl.rewards.generative import GenerativeReward, Prior
from giril_rl.rewards.generative_loss import (
    GenerativeRewardLoss,
    action_term,
    gaussian_kl,
)
from giril_rl.rewards.noise import NoiseReward
from giril_rl.rewards.pixel_scaler import PixelScaler
from giril_rl.rewards.scaler import ObservationScaler, ScalingRule
from giril_rl.rewards.transition_loss import TransitionLoss

__all__ = [
    "ActionEncoder",
    "AffineReward",
    "BottleneckLoss",
    "BottleneckReward",
    "ConstantReward",
    "CopyReward",
    "CuriosityReward",
    "CuriosityRewardLoss",
    "DiscriminatorLoss",
    "DiscriminatorReward",
    "DiscriminatorScaling",
    "FeatureTraining",
    "GenerativeReward",
    "GenerativeRewardLoss",
    "NoiseReward",
    "ObservationScaler",
    "PixelScaler",
    "Prior",
    "RewardForm",
    "ScalingRule",
    "TransitionLoss",
    "action_term",
    "adversarial_reward",
    "blend_action",
    "discriminator_loss",
    "factored_error",
    "feature_error",
    "fit",
    "gaussian_kl",
    "gradient_penalty",
    "reconstruction_error",
]
