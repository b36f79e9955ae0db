"""Rewards: one file a method, each with its settings, maths, module, loss and registry entry."""

from giril_rl.rewards.actions import ActionEncoder
from giril_rl.rewards.adversarial import (
    DiscriminatorConfig,
    DiscriminatorScaling,
    RewardForm,
    adversarial_reward,
    discriminator_loss,
    gradient_penalty,
)
from giril_rl.rewards.bottleneck import (
    BottleneckConfig,
    BottleneckLoss,
    BottleneckReward,
    bottleneck_loss,
    bottleneck_reward,
)
from giril_rl.rewards.controls import (
    AffineReward,
    ConstantReward,
    CopyReward,
    NoiseReward,
    copy_reward,
)
from giril_rl.rewards.curiosity import (
    CuriosityConfig,
    CuriosityReward,
    CuriosityRewardLoss,
    FeatureTraining,
    curiosity_reward,
    feature_error,
)
from giril_rl.rewards.discriminator import (
    AdversarialConfig,
    DiscriminatorLoss,
    DiscriminatorReward,
    discriminator_reward,
)
from giril_rl.rewards.factored import factored_error
from giril_rl.rewards.fitting import TransitionLoss, fit
from giril_rl.rewards.generative import (
    GenerativeConfig,
    GenerativeReward,
    GenerativeRewardLoss,
    Prior,
    action_term,
    blend_action,
    gaussian_kl,
    generative_reward,
    reconstruction_error,
)
from giril_rl.rewards.pwil import PWILConfig, PWILReward, greedy_coupling, pwil_reward, pwil_value
from giril_rl.rewards.scaler import ObservationScaler, PixelScaler, ScalingRule
from giril_rl.rewards.sinkhorn import (
    SinkhornConfig,
    SinkhornReward,
    sinkhorn_plan,
    sinkhorn_reward,
    sinkhorn_value,
)
from giril_rl.rewards.trajectory import TrajectoryReward, fresh_episodes

__all__ = [
    "ActionEncoder",
    "AdversarialConfig",
    "AffineReward",
    "BottleneckConfig",
    "BottleneckLoss",
    "BottleneckReward",
    "ConstantReward",
    "CopyReward",
    "CuriosityConfig",
    "CuriosityReward",
    "CuriosityRewardLoss",
    "DiscriminatorConfig",
    "DiscriminatorLoss",
    "DiscriminatorReward",
    "DiscriminatorScaling",
    "FeatureTraining",
    "GenerativeConfig",
    "GenerativeReward",
    "GenerativeRewardLoss",
    "NoiseReward",
    "ObservationScaler",
    "PWILConfig",
    "PWILReward",
    "PixelScaler",
    "Prior",
    "RewardForm",
    "ScalingRule",
    "SinkhornConfig",
    "SinkhornReward",
    "TrajectoryReward",
    "TransitionLoss",
    "action_term",
    "adversarial_reward",
    "blend_action",
    "bottleneck_loss",
    "bottleneck_reward",
    "copy_reward",
    "curiosity_reward",
    "discriminator_loss",
    "discriminator_reward",
    "factored_error",
    "feature_error",
    "fit",
    "fresh_episodes",
    "gaussian_kl",
    "generative_reward",
    "gradient_penalty",
    "greedy_coupling",
    "pwil_reward",
    "pwil_value",
    "reconstruction_error",
    "sinkhorn_plan",
    "sinkhorn_reward",
    "sinkhorn_value",
]
