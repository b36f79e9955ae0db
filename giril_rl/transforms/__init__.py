"""TorchRL transforms of rewards, for an environment, a batch or a replay buffer alike."""

from giril_rl.transforms.absorbing import AbsorbingReward
from giril_rl.transforms.batch_mean import BatchMeanReward
from giril_rl.transforms.checking import check_reward
from giril_rl.transforms.intrinsic import IntrinsicReward
from giril_rl.transforms.running_return import discounted_filter, running_moments
from giril_rl.transforms.scaling import ReturnScaling
from giril_rl.transforms.sync import RewardWeightSyncScheme
from giril_rl.transforms.weighted import WeightedReward

__all__ = [
    "AbsorbingReward",
    "BatchMeanReward",
    "IntrinsicReward",
    "ReturnScaling",
    "RewardWeightSyncScheme",
    "WeightedReward",
    "check_reward",
    "discounted_filter",
    "running_moments",
]
