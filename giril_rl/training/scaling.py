"""The reward scaling that a config asks for."""

from __future__ import annotations

from typing import cast

from torchrl.envs import Transform

from giril_rl.config.schema import ScalingConfig
from giril_rl.transforms import ReturnScaling
from giril_rl.transforms.scaling import ResetRule


def return_scaling(cfg: ScalingConfig, gamma: float) -> list[Transform]:
    """The transform in a list, or an empty list where scaling is off.

    Examples:
        >>> return_scaling(ScalingConfig(enabled=False), gamma=0.99)
        []
    """
    if not cfg.enabled:
        return []
    return [ReturnScaling(gamma, reset=cast(ResetRule, cfg.reset), clip=cfg.clip)]
