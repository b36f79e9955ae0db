"""Control: PPO on a reward that knows nothing of the demonstration, for comparison."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path

from torchrl.envs import Compose

from giril_rl.configs import RunConfig, ScalingConfig, knob
from giril_rl.envs import gym_factory, make_env
from giril_rl.rewards import ConstantReward
from giril_rl.training import Run, finish_run, make_agent, return_scaling, train_ppo
from giril_rl.transforms import IntrinsicReward


@dataclass
class Config(RunConfig):
    """What `giril run control` takes."""

    reward: str = knob(
        "constant", "the reward that stands in for a learned one", choices=["constant"]
    )
    scaling: ScalingConfig = field(default_factory=ScalingConfig)


def main(cfg: Config, out: Path) -> None:
    """Train a policy on the control reward and leave its run folder in ``out``."""
    gym_factory(cfg.task)  # Refuses an unknown environment before a folder is made.
    with Run.open(out, asdict(cfg), recipe="control", logger=cfg.logger) as run:
        if run.finished:
            return
        env = make_env(cfg.task, cfg.ppo.num_envs, cfg.seed)
        relabel = Compose(
            IntrinsicReward(ConstantReward()), *return_scaling(cfg.scaling, cfg.ppo.gamma)
        )
        agent = make_agent(env, cfg.ppo, cfg.seed)
        trained = train_ppo(env, agent, relabel, cfg.ppo, steps=cfg.steps, seed=cfg.seed, run=run)
        finish_run(run, cfg, agent, trained, method=f"control:{cfg.reward}")
