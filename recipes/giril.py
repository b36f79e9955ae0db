"""GIRIL: a reward from a generative model of the demonstration, and a policy that maximises it.

Demonstration -> conditional VAE -> intrinsic reward -> PPO -> score on the true reward.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from torchrl.envs import Compose

from giril_rl.config.schema import AveragedRunConfig, FitConfig
from giril_rl.demos import holdout, subsample
from giril_rl.envs import make_env
from giril_rl.rewards import GenerativeConfig, GenerativeRewardLoss, generative_reward
from giril_rl.training import (
    finish_run,
    fit_reward,
    make_algorithm,
    obtain_demonstration,
    open_run,
    return_scaling,
    train_policy,
)
from giril_rl.transforms import BatchMeanReward, IntrinsicReward


@dataclass
class Config(AveragedRunConfig):
    """What `giril run giril` takes."""

    reward: GenerativeConfig = field(default_factory=GenerativeConfig)
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
        reward = generative_reward(cfg.reward, env, pairs, seed=seed).to(cfg.device)
        loss = GenerativeRewardLoss(reward, alpha=cfg.reward.alpha)
        fit_reward(loss, pairs, cfg.fit, seed=seed, run=run, validation=validation)

        transform = Compose(
            IntrinsicReward(reward),
            *[BatchMeanReward()] * cfg.batch_mean,
            *return_scaling(cfg),
        )
        learner = make_algorithm(env, cfg, run=run, demo=demo, transform=transform)
        trained = train_policy(env, learner, transform, seed=cfg.seed, run=run)
        finish_run(run, cfg, learner.agent, trained, expert=expert, demo=demo, reward=reward)
