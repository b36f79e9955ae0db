"""VAIL: GAIL with a discriminator that sees a pair only through an information bottleneck.

Demonstration -> discriminator <-> policy on its reward -> score on the true reward.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from torchrl.envs import Compose

from giril_rl.config.schema import RewardRunConfig
from giril_rl.demos import subsample
from giril_rl.envs import make_env
from giril_rl.rewards import BottleneckConfig, bottleneck_loss, bottleneck_reward
from giril_rl.training import (
    AdversarialTrainer,
    absorbing_value,
    finish_run,
    make_algorithm,
    obtain_demonstration,
    open_run,
    return_scaling,
    terminal_rate,
    train_policy,
)
from giril_rl.transforms import IntrinsicReward


@dataclass
class Config(RewardRunConfig):
    """What `giril run vail` takes."""

    reward: BottleneckConfig = field(default_factory=BottleneckConfig)


def main(cfg: Config, out: Path) -> None:
    """Train the whole chain and leave its run folder in ``out``."""
    with open_run(cfg, out, recipe=Path(__file__).stem) as run:
        if run.finished:
            return
        demo, expert = obtain_demonstration(cfg)
        pairs = subsample(demo, cfg.demo.subsample)
        env = run.closing(make_env(cfg.task, cfg.learner.num_envs, cfg.seed))

        seed, settings = cfg.reward_seed, cfg.reward.settled(cfg)
        reward = bottleneck_reward(settings, env, pairs, seed=seed).to(cfg.device)
        loss = bottleneck_loss(reward, settings)

        absorbing = absorbing_value(reward, cfg.learner.gamma)
        transform = Compose(IntrinsicReward(reward), *absorbing, *return_scaling(cfg))
        learner = make_algorithm(env, cfg, run=run, demo=demo, transform=transform, moving=True)
        ends = terminal_rate(demo.transitions)
        trainer = AdversarialTrainer(
            loss, pairs, settings, seed=seed, source=learner.own, terminal_rate=ends
        )
        trained = train_policy(
            env, learner, transform, seed=cfg.seed, run=run, reward_trainer=trainer
        )
        finish_run(run, cfg, learner.agent, trained, expert=expert, demo=demo, reward=reward)
