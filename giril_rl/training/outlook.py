"""How long a run will take, said before it begins."""

from __future__ import annotations

import sys

from giril_rl.config.schema import DemoConfig, ExpertConfig, FitConfig, RunConfig

STEPS_PER_SECOND = {
    "vector": {"player": 6_000, "reward model": 3_000, "policy": 6_000},
    "image": {"player": 500, "reward model": 12, "policy": 500},
}
"""Rough rates of one core of a server of 2023, by kind of observation."""


def outlook(cfg: RunConfig, expert: ExpertConfig, demo: DemoConfig, *, has_player: bool) -> str:
    """One sentence that names each part of a run, its steps and about how long they take.

    Args:
        cfg: the recipe's settings.
        expert: its expert's.
        demo: its demonstration's.
        has_player: whether the player is there already.

    Examples:
        >>> from giril_rl.config.schema import TaskConfig
        >>> cfg = RunConfig(task=TaskConfig(name="pong", env_id="ALE/Pong-v5"), steps=1_000_000)
        >>> print(outlook(cfg, ExpertConfig(), DemoConfig(), has_player=False))
        player: at most 5,000,000 steps, about 2.8 h; policy: 1,000,000 steps, about 33 min (rough
        figures for one core, the bars below tell yours)
    """
    rates = STEPS_PER_SECOND[cfg.task.family.observation]
    parts = []
    if demo.path is None and expert.path is None and not has_player:
        most = expert.steps_on(cfg.task)
        parts.append(f"player: at most {most:,} steps, about {_spell(most / rates['player'])}")
    fit = getattr(cfg, "fit", None)
    if isinstance(fit, FitConfig) and fit.steps:
        seconds = fit.steps / rates["reward model"]
        parts.append(f"reward model: {fit.steps:,} steps, about {_spell(seconds)}")
    if cfg.steps:
        seconds = cfg.steps / rates["policy"]
        parts.append(f"policy: {cfg.steps:,} steps, about {_spell(seconds)}")
    return f"{'; '.join(parts)} (rough figures for one core, the bars below tell yours)"


def announce(cfg: RunConfig, expert: ExpertConfig, demo: DemoConfig, *, has_player: bool) -> None:
    """Prints :func:`outlook` to the terminal, where a part takes more than a minute."""
    sentence = outlook(cfg, expert, demo, has_player=has_player)
    if any(unit in sentence for unit in (" min", " h", " days")):
        print(sentence, file=sys.stderr)


def _spell(seconds: float) -> str:
    if seconds < 90:
        return f"{max(round(seconds), 1)} s"
    if seconds < 90 * 60:
        return f"{round(seconds / 60)} min"
    if seconds < 48 * 3600:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 86400:.1f} days"
