"""Nearest neighbour: a reward for transitions close to the demonstration's, and a policy for it.

Demonstration -> 1 - squared distance to its nearest transition -> SAC or PPO -> true score.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from torchrl.envs import Compose

from giril_rl.config.schema import OffPolicyRunConfig
from giril_rl.demos import subsample
from giril_rl.envs import make_env
from giril_rl.rewards.nearest import NearestConfig, nearest_neighbour
from giril_rl.training import (
    finish_run,
    make_algorithm,
    obtain_demonstration,
    open_run,
    return_scaling,
    train_policy,
)
from giril_rl.transforms import IntrinsicReward


@dataclass
class Config(OffPolicyRunConfig):
    """What `giril run nearest` takes."""

    reward: NearestConfig = field(default_factory=NearestConfig)


def main(cfg: Config, out: Path) -> None:
    """Train the whole chain and leave its run folder in ``out``."""
    with open_run(cfg, out, recipe=Path(__file__).stem) as run:
        if run.finished:
            return
        demo, expert = obtain_demonstration(cfg)
        pairs = subsample(demo, cfg.demo.subsample)
        env = run.closing(make_env(cfg.task, cfg.learner.num_envs, cfg.seed))

        reward = nearest_neighbour(cfg.reward, env, pairs, seed=cfg.reward_seed).to(cfg.device)

        transform = Compose(IntrinsicReward(reward), *return_scaling(cfg))
        learner = make_algorithm(env, cfg, run=run, demo=demo, transform=transform)
        trained = train_policy(env, learner, transform, seed=cfg.seed, run=run)
        finish_run(run, cfg, learner.agent, trained, expert=expert, demo=demo, reward=reward)
