"""ILDE: imitation, curiosity about what departs from the demonstration, and a state-entropy bonus.

Demonstration -> discriminator <-> policy on the weighted sum of three rewards -> true score.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tensordict import TensorDictBase
from torchrl.envs import Compose, EnvBase, Transform

from giril_rl.config.schema import FitConfig, RewardRunConfig
from giril_rl.demos import Demonstration, holdout, subsample
from giril_rl.envs import make_env
from giril_rl.methods.controls import moments
from giril_rl.rewards import (
    AdversarialConfig,
    AffineReward,
    BottleneckConfig,
    BottleneckLoss,
    DiscriminatorLoss,
    GenerativeConfig,
    GenerativeRewardLoss,
    bottleneck_reward,
    discriminator_reward,
    generative_reward,
)
from giril_rl.rewards.entropy_bonus import EntropyBonusConfig, entropy_bonus
from giril_rl.rewards.ilde import ILDEConfig, InMinibatches, SummedReward, Term
from giril_rl.rewards.pwil import PWILConfig, pwil_reward
from giril_rl.training import (
    AdversarialTrainer,
    Run,
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
class Coupling(PWILConfig):
    """PWIL's settings, which are read only where PWIL is the imitation reward."""

    def check(self, prefix: str, run: Any) -> None:
        """Refuses what PWIL does."""
        if run.reward.along_time:
            super().check(prefix, run)


@dataclass
class Config(RewardRunConfig):
    """What `giril run ilde` takes; settings of a term that is switched off are not read."""

    reward: ILDEConfig = field(default_factory=ILDEConfig)
    gail: AdversarialConfig = field(default_factory=AdversarialConfig)
    vail: BottleneckConfig = field(default_factory=BottleneckConfig)
    giril: GenerativeConfig = field(default_factory=GenerativeConfig)
    pwil: Coupling = field(default_factory=Coupling)
    bonus: EntropyBonusConfig = field(default_factory=EntropyBonusConfig)
    fit: FitConfig = field(default_factory=FitConfig)


def main(cfg: Config, out: Path) -> None:
    """Train the whole chain and leave its run folder in ``out``."""
    with open_run(cfg, out, recipe=Path(__file__).stem) as run:
        if run.finished:
            return
        demo, expert = obtain_demonstration(cfg)
        pairs = subsample(demo, cfg.demo.subsample)
        env = run.closing(make_env(cfg.task, cfg.learner.num_envs, cfg.seed))

        weights, terms = cfg.reward, {}
        loss: DiscriminatorLoss | None = None
        absorbing: list[Transform] = []
        if weights.along_time:
            coupling = pwil_reward(cfg.pwil, env, pairs, seed=cfg.reward_seed).to(cfg.device)
            terms["imitation"] = Term(weights.imitation_weight, coupling)
        elif weights.imitates:
            loss = discriminator(cfg, env, pairs)
            terms["imitation"] = Term(weights.imitation_weight, loss.reward)
            absorbing = absorbing_value(loss.reward, cfg.learner.gamma, weights.imitation_weight)
        if weights.curiosity_weight:
            terms["curiosity"] = Term(weights.curiosity_weight, curiosity(cfg, env, demo, run))
        if weights.bonus_weight:
            bonus = entropy_bonus(cfg.bonus, env, pairs, seed=cfg.reward_seed).to(cfg.device)
            terms["bonus"] = Term(weights.bonus_weight, InMinibatches(bonus, cfg.sac.batch))
        reward = SummedReward(terms)

        transform = Compose(IntrinsicReward(reward), *absorbing, *return_scaling(cfg))
        moving = not weights.along_time and (weights.imitates or weights.bonus_weight > 0)
        learner = make_algorithm(env, cfg, run=run, demo=demo, transform=transform, moving=moving)
        trainer = None
        if loss is not None:
            trainer = AdversarialTrainer(
                loss,
                pairs,
                settings_of(cfg),
                seed=cfg.reward_seed,
                source=learner.own,
                terminal_rate=terminal_rate(demo.transitions),
            )
        trained = train_policy(
            env, learner, transform, seed=cfg.seed, run=run, reward_trainer=trainer
        )
        finish_run(run, cfg, learner.agent, trained, expert=expert, demo=demo, reward=reward)


def settings_of(cfg: Config) -> AdversarialConfig:
    """The chosen discriminator's settings, as the learner needs them."""
    return (cfg.gail if cfg.reward.imitation == "gail" else cfg.vail).settled(cfg)


def discriminator(cfg: Config, env: EnvBase, pairs: TensorDictBase) -> DiscriminatorLoss:
    """The loss of GAIL's discriminator or VAIL's, untrained."""
    settings, seed = settings_of(cfg), cfg.reward_seed
    if not isinstance(settings, BottleneckConfig):
        reward = discriminator_reward(settings, env, pairs, seed=seed).to(cfg.device)
        return DiscriminatorLoss(reward, penalty=settings.penalty)
    return BottleneckLoss(
        bottleneck_reward(settings, env, pairs, seed=seed).to(cfg.device),
        information=settings.information,
        beta_step=settings.beta_step,
        beta=settings.beta_start,
        penalty=settings.penalty,
    )


def curiosity(cfg: Config, env: EnvBase, demo: Demonstration, run: Run) -> Any:
    """GIRIL's error, trained, over its mean on the demonstration."""
    pairs, validation = subsample(demo, cfg.demo.subsample), holdout(demo, cfg.demo.subsample)
    reward = generative_reward(cfg.giril, env, pairs, seed=cfg.reward_seed).to(cfg.device)
    loss = GenerativeRewardLoss(reward, alpha=cfg.giril.alpha)
    fit_reward(loss, pairs, cfg.fit, seed=cfg.reward_seed, run=run, validation=validation)
    return AffineReward(reward, scale=1 / moments(reward, pairs)[0]).to(cfg.device)
