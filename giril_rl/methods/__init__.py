"""The registry of methods, and the controls' recipe."""

from giril_rl.methods.controls import (
    ControlRunConfig,
    baseline_policy,
    check_baseline,
    control_reward,
)
from giril_rl.methods.registry import controls, methods

__all__ = [
    "ControlRunConfig",
    "baseline_policy",
    "check_baseline",
    "control_reward",
    "controls",
    "methods",
]
