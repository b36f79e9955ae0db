"""SQIL: reward 1 for what was demonstrated, 0 for what the agent does; nothing else is learned.

Demonstration -> half of each minibatch of SAC -> score on the true reward.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from giril_rl.config.schema import OffPolicyRunConfig, SACConfig, ScalingConfig
from giril_rl.demos import subsample
from giril_rl.envs import make_env
from giril_rl.rewards.sqil import SQILConfig, sqil_reward
from giril_rl.training import (
    finish_run,
    make_algorithm,
    obtain_demonstration,
    open_run,
    train_policy,
)
from giril_rl.transforms import IntrinsicReward


@dataclass
class Config(OffPolicyRunConfig):
    """What `giril run sqil` takes."""

    sac: SACConfig = field(default_factory=lambda: SACConfig(demonstration="half"))
    scaling: ScalingConfig = field(default_factory=lambda: ScalingConfig(enabled=False))
    reward: SQILConfig = field(default_factory=SQILConfig)


def main(cfg: Config, out: Path) -> None:
    """Train the whole chain and leave its run folder in ``out``."""
    with open_run(cfg, out, recipe=Path(__file__).stem) as run:
        if run.finished:
            return
        demo, expert = obtain_demonstration(cfg)
        pairs = subsample(demo, cfg.demo.subsample)
        env = run.closing(make_env(cfg.task, cfg.learner.num_envs, cfg.seed))

        reward = sqil_reward(cfg.reward, env, pairs, seed=cfg.reward_seed)
        transform = IntrinsicReward(reward)
        paid = cfg.reward.demonstration
        learner = make_algorithm(
            env, cfg, run=run, demo=demo, transform=transform, demonstration_reward=paid
        )
        trained = train_policy(env, learner, transform, seed=cfg.seed, run=run)
        finish_run(run, cfg, learner.agent, trained, expert=expert, demo=demo, reward=reward)
