"""Expert: PPO on the environment's own reward, the player that the other recipes imitate."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from giril_rl.config.schema import ExpertRunConfig
from giril_rl.training import train_expert


@dataclass
class Config(ExpertRunConfig):
    """What `giril run expert` takes."""


def main(cfg: Config, out: Path) -> None:
    """Train an expert and leave its run folder in ``out``."""
    train_expert(cfg, out, recipe=Path(__file__).stem)
