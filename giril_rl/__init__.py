"""GIRIL and the methods it is compared with, as TorchRL parts and recipes.

The transforms are imported when first used, so that the command line answers at once.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from giril_rl import moved

if TYPE_CHECKING:
    from giril_rl.transforms import (
        BatchMeanReward,
        IntrinsicReward,
        ReturnScaling,
        RewardWeightSyncScheme,
        WeightedReward,
        check_reward,
    )

moved.install()

__all__ = [
    "BatchMeanReward",
    "IntrinsicReward",
    "ReturnScaling",
    "RewardWeightSyncScheme",
    "WeightedReward",
    "check_reward",
]


def __getattr__(name: str) -> Any:
    if name in __all__:
        return getattr(import_module("giril_rl.transforms"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
