"""RED: a reward for staying where the demonstration has been, and a policy that maximises it.

Demonstration -> a network that predicts a random one -> exp(-error) -> PPO -> true score.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from torchrl.envs import Compose

from giril_rl.config.schema import FitConfig, RewardRunConfig
from giril_rl.demos import holdout, subsample
from giril_rl.envs import make_env
from giril_rl.rewards.red import DistillationConfig, DistillationLoss, red_reward
from giril_rl.training import (
    finish_run,
    fit_reward,
    make_algorithm,
    obtain_demonstration,
    open_run,
    return_scaling,
    train_policy,
)
from giril_rl.transforms import IntrinsicReward


@dataclass
class Config(RewardRunConfig):
    """What `giril run red` takes."""

    reward: DistillationConfig = field(default_factory=DistillationConfig)
    fit: FitConfig = field(default_factory=FitConfig)


def main(cfg: Config, out: Path) -> None:
    """Train the whole chain and leave its run folder in ``out``."""
    with open_run(cfg, out, recipe=Path(__file__).stem) as run:
        if run.finished:
            return
        demo, expert = obtain_demonstration(cfg)
        pairs, validation = subsample(demo, cfg.demo.subsample), holdout(demo, cfg.demo.subsample)
        env = run.closing(make_env(cfg.task, cfg.learner.num_envs, cfg.seed))

        seed = cfg.reward_seed
        reward = red_reward(cfg.reward, env, pairs, seed=seed).to(cfg.device)
        loss = DistillationLoss(reward)
        fit_reward(loss, pairs, cfg.fit, seed=seed, run=run, validation=validation)
        if cfg.reward.sigma is None:
            reward.calibrate(pairs, cfg.reward.demo_reward)

        transform = Compose(IntrinsicReward(reward), *return_scaling(cfg))
        learner = make_algorithm(env, cfg, run=run, demo=demo, transform=transform)
        trained = train_policy(env, learner, transform, seed=cfg.seed, run=run)
        finish_run(run, cfg, learner.agent, trained, expert=expert, demo=demo, reward=reward)
