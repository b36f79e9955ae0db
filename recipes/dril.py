"""DRIL: a reward for acting where cloned policies agree, and a policy cloned beside.

Demonstration -> ensemble of cloned policies -> +1 where they agree, -1 elsewhere -> SAC or PPO with
behaviour cloning -> true score.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from torchrl.envs import Compose

from giril_rl.config.schema import FitConfig, OffPolicyRunConfig
from giril_rl.demos import holdout, subsample
from giril_rl.envs import make_env
from giril_rl.rewards.disagreement import bootstrapped
from giril_rl.rewards.dril import DisagreementConfig, DisagreementLoss, dril_reward
from giril_rl.training import (
    finish_run,
    fit_reward,
    make_algorithm,
    make_cloning,
    obtain_demonstration,
    open_run,
    return_scaling,
    train_policy,
)
from giril_rl.transforms import IntrinsicReward


@dataclass
class Config(OffPolicyRunConfig):
    """What `giril run dril` takes."""

    reward: DisagreementConfig = field(default_factory=DisagreementConfig)
    # Cloning's, as in the authors' code.
    fit: FitConfig = field(default_factory=lambda: FitConfig(steps=10_000, batch=100, lr=2.5e-4))


def main(cfg: Config, out: Path) -> None:
    """Train the whole chain and leave its run folder in ``out``."""
    with open_run(cfg, out, recipe=Path(__file__).stem) as run:
        if run.finished:
            return
        demo, expert = obtain_demonstration(cfg)
        pairs, validation = subsample(demo, cfg.demo.subsample), holdout(demo, cfg.demo.subsample)
        env = run.closing(make_env(cfg.task, cfg.learner.num_envs, cfg.seed))

        seed, settings = cfg.reward_seed, cfg.reward
        reward = dril_reward(settings, env, pairs, seed=seed).to(cfg.device)
        samples = bootstrapped(pairs, settings.members, seed=seed)
        # Every member is held to all of what no member has seen.
        validation = bootstrapped(validation, settings.members, seed=None)
        loss = DisagreementLoss(reward, bootstrap=True)
        fit_reward(loss, samples, cfg.fit, seed=seed, run=run, validation=validation)
        reward.calibrate(pairs, settings.quantile)

        transform = Compose(IntrinsicReward(reward), *return_scaling(cfg))
        learner = make_algorithm(env, cfg, run=run, demo=demo, transform=transform)
        cloning = make_cloning(learner.agent, pairs, settings, seed=cfg.seed)
        trained = train_policy(
            env, learner, transform, seed=cfg.seed, run=run, reward_trainer=cloning
        )
        finish_run(run, cfg, learner.agent, trained, expert=expert, demo=demo, reward=reward)
