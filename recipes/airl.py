"""AIRL: a reward of the form of an advantage, from a discriminator trained beside the policy.

Demonstration -> discriminator <-> policy on its reward -> score on the true reward.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from torchrl.envs import Compose

from giril_rl.config.schema import RewardRunConfig
from giril_rl.demos import subsample
from giril_rl.envs import make_env
from giril_rl.rewards.airl import AIRLConfig, AIRLLoss, airl_reward, with_log_prob
from giril_rl.training import (
    PPO,
    AdversarialTrainer,
    finish_run,
    make_agent,
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
        env = run.closing(make_env(cfg.task, cfg.ppo.num_envs, cfg.seed))
        agent = make_agent(env, cfg.ppo, cfg.seed).to(cfg.device)

        seed, settings = cfg.reward_seed, cfg.reward.settled(cfg)
        reward = airl_reward(settings, env, pairs, seed=seed).to(cfg.device)
        loss = AIRLLoss(reward, penalty=settings.penalty)
        trainer = AdversarialTrainer(loss, pairs, settings, seed=seed, log_prob=agent.log_prob)

        transform = Compose(
            IntrinsicReward(with_log_prob(reward, agent.log_prob)),
            *return_scaling(cfg.scaling, cfg.ppo.gamma),
        )
        ppo = PPO(agent, cfg.ppo, steps=cfg.steps, termination=cfg.termination)
        trained = train_policy(env, ppo, transform, seed=cfg.seed, run=run, reward_trainer=trainer)
        finish_run(run, cfg, agent, trained, expert=expert, demo=demo, reward=reward)
