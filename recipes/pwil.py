"""PWIL: a reward for visiting what the demonstration visited, and a policy that maximises it.

Demonstration -> each step's cost of moving onto what is left of it -> exp(-cost) -> SAC -> true
score.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from torchrl.envs import Compose

from giril_rl.config.schema import OffPolicyRunConfig, SACConfig, ScalingConfig
from giril_rl.demos import subsample
from giril_rl.envs import make_env
from giril_rl.rewards.pwil import PWILConfig, pwil_reward
from giril_rl.training import (
    finish_run,
    make_algorithm,
    obtain_demonstration,
    open_run,
    return_scaling,
    train_policy,
)
from giril_rl.transforms import IntrinsicReward


@dataclass
class Config(OffPolicyRunConfig):
    """What `giril run pwil` takes."""

    scaling: ScalingConfig = field(default_factory=lambda: ScalingConfig(enabled=False))
    # What a step is worth depends on what the episode visited before.
    sac: SACConfig = field(default_factory=lambda: SACConfig(time_aware_critic=True))
    reward: PWILConfig = field(default_factory=PWILConfig)


def main(cfg: Config, out: Path) -> None:
    """Train the whole chain and leave its run folder in ``out``."""
    with open_run(cfg, out, recipe=Path(__file__).stem) as run:
        if run.finished:
            return
        demo, expert = obtain_demonstration(cfg)
        pairs = subsample(demo, cfg.demo.subsample)
        env = run.closing(make_env(cfg.task, cfg.learner.num_envs, cfg.seed))

        reward = pwil_reward(cfg.reward, env, pairs, seed=cfg.reward_seed).to(cfg.device)

        transform = Compose(IntrinsicReward(reward), *return_scaling(cfg))
        learner = make_algorithm(env, cfg, run=run, demo=demo, transform=transform)
        trained = train_policy(env, learner, transform, seed=cfg.seed, run=run)
        finish_run(run, cfg, learner.agent, trained, expert=expert, demo=demo, reward=reward)
