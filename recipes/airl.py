"""AIRL: a reward of the form of an advantage, from a discriminator trained beside the policy.

Demonstration -> discriminator <-> policy on its reward -> score on the true reward.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from torch import Tensor
from torchrl.envs import Compose

from giril_rl.config.schema import RewardRunConfig
from giril_rl.demos import subsample
from giril_rl.envs import make_env
from giril_rl.rewards.airl import AIRLConfig, AIRLLoss, airl_reward, with_log_prob
from giril_rl.training import (
    AdversarialTrainer,
    finish_run,
    make_algorithm,
    obtain_demonstration,
    open_run,
    return_scaling,
    train_policy,
)
from giril_rl.transforms import IntrinsicReward


@dataclass
class Config(RewardRunConfig):
    """What `giril run airl` takes."""

    reward: AIRLConfig = field(default_factory=AIRLConfig)


def main(cfg: Config, out: Path) -> None:
    """Train the whole chain and leave its run folder in ``out``."""
    with open_run(cfg, out, recipe=Path(__file__).stem) as run:
        if run.finished:
            return
        demo, expert = obtain_demonstration(cfg)
        pairs = subsample(demo, cfg.demo.subsample)
        env = run.closing(make_env(cfg.task, cfg.learner.num_envs, cfg.seed))

        def log_prob(observation: Tensor, action: Tensor) -> Tensor:
            return learner.agent.log_prob(observation, action)

        seed, settings = cfg.reward_seed, cfg.reward.settled(cfg)
        reward = airl_reward(settings, env, pairs, seed=seed).to(cfg.device)
        loss = AIRLLoss(reward, penalty=settings.penalty)

        transform = Compose(IntrinsicReward(with_log_prob(reward, log_prob)), *return_scaling(cfg))
        learner = make_algorithm(env, cfg, run=run, demo=demo, transform=transform, moving=True)
        trainer = AdversarialTrainer(
            loss, pairs, settings, seed=seed, source=learner.own, log_prob=log_prob
        )
        trained = train_policy(
            env, learner, transform, seed=cfg.seed, run=run, reward_trainer=trainer
        )
        finish_run(run, cfg, learner.agent, trained, expert=expert, demo=demo, reward=reward)
