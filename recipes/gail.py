"""GAIL: a reward from a discriminator trained beside the policy that maximises it.

Demonstration -> discriminator <-> policy on its reward -> score on the true reward.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from torchrl.envs import Compose

from giril_rl.config.schema import RewardRunConfig
from giril_rl.demos import subsample
from giril_rl.envs import make_env
from giril_rl.rewards import AdversarialConfig, DiscriminatorLoss, discriminator_reward
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
    """What `giril run gail` takes."""

    reward: AdversarialConfig = field(default_factory=AdversarialConfig)


def main(cfg: Config, out: Path) -> None:
    """Train the whole chain and leave its run folder in ``out``."""
    with open_run(cfg, out, recipe=Path(__file__).stem) as run:
        if run.finished:
            return
        demo, expert = obtain_demonstration(cfg)
        pairs = subsample(demo, cfg.demo.subsample)
        env = run.closing(make_env(cfg.task, cfg.learner.num_envs, cfg.seed))

        seed, settings = cfg.reward_seed, cfg.reward.settled(cfg)
        reward = discriminator_reward(settings, env, pairs, seed=seed).to(cfg.device)
        loss = DiscriminatorLoss(reward, penalty=settings.penalty)

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
