"""About how long a run will take, said before it begins."""

from __future__ import annotations

import sys

from giril_rl.config.schema import DemoConfig, ExpertConfig, FitConfig, RunConfig

STEPS_PER_SECOND = {
    "vector": {"player": 6_000, "reward model": 3_000, "policy": 6_000},
    "image": {"player": 500, "reward model": 12, "policy": 500},
}
"""Rough rates of one core of a server of 2023, by kind of observation."""
SAC_UPDATES_PER_SECOND = 300
"""The same for gradient steps of SAC, two hidden layers of 128 units and minibatches of 128."""


def outlook(
    cfg: RunConfig,
    expert: ExpertConfig | None = None,
    demo: DemoConfig | None = None,
    *,
    has_player: bool = False,
) -> dict[str, float]:
    """The parts of a run, each with about how many seconds it takes on one core.

    Args:
        cfg: the recipe's settings.
        expert: its expert's; None where it learns from nobody.
        demo: its demonstration's; None for the same.
        has_player: whether the player is there already.

    Examples:
        >>> from giril_rl.config.schema import TaskConfig
        >>> cfg = RunConfig(task=TaskConfig(name="pong", env_id="ALE/Pong-v5"), steps=1_000_000)
        >>> outlook(cfg, ExpertConfig(), DemoConfig(), has_player=False)
        {'player: at most 5,000,000 steps': 10000.0, 'policy: 1,000,000 steps': 2000.0}
    """
    rates = STEPS_PER_SECOND[cfg.task.family.observation]
    parts = {}
    if expert and demo and demo.path is None and expert.path is None and not has_player:
        most = expert.steps_on(cfg.task)
        parts[f"player: at most {most:,} steps"] = most / rates["player"]
    fit = getattr(cfg, "fit", None)
    if isinstance(fit, FitConfig) and fit.steps:
        parts[f"reward model: {fit.steps:,} steps"] = fit.steps / rates["reward model"]
    if cfg.steps:
        rate = (
            SAC_UPDATES_PER_SECOND / cfg.sac.updates if cfg.algorithm == "sac" else rates["policy"]
        )
        parts[f"policy: {cfg.steps:,} steps"] = cfg.steps / rate
    return parts


def announce(
    cfg: RunConfig,
    expert: ExpertConfig | None = None,
    demo: DemoConfig | None = None,
    *,
    has_player: bool = False,
) -> None:
    """Prints :func:`outlook` to the terminal, where a part takes 90 seconds or more."""
    parts = outlook(cfg, expert, demo, has_player=has_player)
    if max(parts.values(), default=0) >= 90:
        told = "; ".join(f"{part}, about {_spell(seconds)}" for part, seconds in parts.items())
        print(f"{told} (rough figures for one core, the bars below tell yours)", file=sys.stderr)


def _spell(seconds: float) -> str:
    if seconds < 90:
        return f"{max(round(seconds), 1)} s"
    if seconds < 90 * 60:
        return f"{round(seconds / 60)} min"
    if seconds < 48 * 3600:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 86400:.1f} days"
