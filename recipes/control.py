"""Control: PPO on a stand-in for a learned reward, or the score of a policy that never learned.

A learned reward has shown something only where it does better than these.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from torchrl.envs import Compose

from giril_rl.envs import make_env
from giril_rl.methods import ControlRunConfig, baseline_policy, check_baseline, control_reward
from giril_rl.training import (
    Trained,
    finish_run,
    make_algorithm,
    obtain_demonstration,
    open_run,
    return_scaling,
    train_policy,
)
from giril_rl.transforms import BatchMeanReward, IntrinsicReward


@dataclass
class Config(ControlRunConfig):
    """What `giril run control` takes."""


def main(cfg: Config, out: Path) -> None:
    """Train a policy on the control reward and leave its run folder in ``out``."""
    check_baseline(cfg)
    with open_run(cfg, out, recipe=Path(__file__).stem) as run:
        if run.finished:
            return
        baseline = baseline_policy(cfg, run)
        if baseline is not None:
            finish_run(run, cfg, baseline, Trained())
            return
        demo, expert = obtain_demonstration(cfg) if cfg.needs_demonstration else (None, None)
        env = run.closing(make_env(cfg.task, cfg.learner.num_envs, cfg.seed))

        reward, seeds = control_reward(cfg, env, demo, run)

        transform = Compose(
            IntrinsicReward(reward),
            *[BatchMeanReward()] * cfg.batch_mean,
            *return_scaling(cfg),
        )
        moving = cfg.method.scope == "batch"  # It depends on the minibatch.
        learner = make_algorithm(env, cfg, run=run, demo=demo, transform=transform, moving=moving)
        trained = train_policy(env, learner, transform, seed=cfg.seed, run=run)
        finish_run(
            run, cfg, learner.agent, trained, expert=expert, demo=demo, reward=reward, seeds=seeds
        )
