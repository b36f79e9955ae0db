"""ILDE: imitation, curiosity about what departs from the demonstration, and a state-entropy bonus.

Demonstration -> discriminator <-> policy on the weighted sum of three rewards -> true score.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from torchrl.envs import Compose

from giril_rl.demos import holdout, subsample
from giril_rl.envs import make_env
from giril_rl.rewards import GenerativeRewardLoss
from giril_rl.rewards.ilde import ILDERunConfig, ilde_reward, imitation_loss
from giril_rl.training import (
    AdversarialTrainer,
    absorbing_value,
    finish_run,
    fit_reward,
    make_algorithm,
    obtain_demonstration,
    open_run,
    return_scaling,
    terminal_rate,
    train_policy,
)
from giril_rl.transforms import IntrinsicReward


@dataclass
class Config(ILDERunConfig):
    """What `giril run ilde` takes; settings of a term that is switched off are not read."""


def main(cfg: Config, out: Path) -> None:
    """Train the whole chain and leave its run folder in ``out``."""
    with open_run(cfg, out, recipe=Path(__file__).stem) as run:
        if run.finished:
            return
        demo, expert = obtain_demonstration(cfg)
        pairs, validation = subsample(demo, cfg.demo.subsample), holdout(demo, cfg.demo.subsample)
        env = run.closing(make_env(cfg.task, cfg.learner.num_envs, cfg.seed))

        seed, weights = cfg.reward_seed, cfg.reward
        reward = ilde_reward(cfg, env, pairs, seed=seed).to(cfg.device)
        if weights.curiosity_weight:
            curiosity = reward.terms["curiosity"]
            loss = GenerativeRewardLoss(curiosity.module, alpha=cfg.giril.alpha)
            fit_reward(loss, pairs, cfg.fit, seed=seed, run=run, validation=validation)
            curiosity.calibrate(pairs)

        absorbing = []
        if weights.discriminates:
            imitation, share = reward.terms["imitation"], weights.imitation_weight
            absorbing = absorbing_value(imitation, cfg.learner.gamma, share)
        transform = Compose(IntrinsicReward(reward), *absorbing, *return_scaling(cfg))
        learner = make_algorithm(
            env, cfg, run=run, demo=demo, transform=transform, moving=weights.moving
        )
        trainer = None
        if weights.discriminates:
            settings, ends = cfg.discriminator, terminal_rate(demo.transitions)
            judge = imitation_loss(imitation, settings)
            trainer = AdversarialTrainer(
                judge, pairs, settings, seed=seed, source=learner.own, terminal_rate=ends
            )
        trained = train_policy(
            env, learner, transform, seed=cfg.seed, run=run, reward_trainer=trainer
        )
        finish_run(run, cfg, learner.agent, trained, expert=expert, demo=demo, reward=reward)
