"""GIRIL: a reward from a generative model of the demonstration, and a policy that maximises it.

Expert -> demonstration -> conditional VAE -> intrinsic reward -> PPO -> score on the true reward.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path

from torchrl.envs import Compose

from giril_rl.config.schema import (
    DemoConfig,
    ExpertConfig,
    FitConfig,
    RunConfig,
    ScalingConfig,
)
from giril_rl.demos import holdout, subsample
from giril_rl.envs import make_env
from giril_rl.rewards import GenerativeConfig, GenerativeRewardLoss, generative_reward
from giril_rl.training import (
    Run,
    check_inputs,
    finish_run,
    fit_reward,
    make_agent,
    obtain_demonstration,
    return_scaling,
    train_ppo,
)
from giril_rl.transforms import BatchMeanReward, IntrinsicReward


@dataclass
class Config(RunConfig):
    """What `giril run giril` takes."""

    expert: ExpertConfig = field(default_factory=ExpertConfig)
    demo: DemoConfig = field(default_factory=DemoConfig)
    reward: GenerativeConfig = field(default_factory=GenerativeConfig)
    fit: FitConfig = field(default_factory=FitConfig)
    scaling: ScalingConfig = field(default_factory=ScalingConfig)


def main(cfg: Config, out: Path) -> None:
    """Train the whole chain and leave its run folder in ``out``."""
    check_inputs(cfg, cfg.expert, cfg.demo)
    with Run.open(out, asdict(cfg), recipe=Path(__file__).stem, logger=cfg.logger) as run:
        if run.finished:
            return
        demo, expert = obtain_demonstration(cfg, cfg.expert, cfg.demo)
        pairs = subsample(demo, cfg.demo.subsample)
        env = run.closing(make_env(cfg.task, cfg.ppo.num_envs, cfg.seed))

        reward_seed = cfg.seed if cfg.reward.seed is None else cfg.reward.seed
        reward = generative_reward(cfg.reward, env, pairs, seed=reward_seed).to(cfg.device)
        fit_reward(
            GenerativeRewardLoss(reward, alpha=cfg.reward.alpha),
            pairs,
            cfg.fit,
            seed=reward_seed,
            run=run,
            held_out=holdout(demo, cfg.demo.subsample),
        )

        relabel = Compose(
            IntrinsicReward(reward),
            *([BatchMeanReward()] if cfg.batch_mean else []),
            *return_scaling(cfg.scaling, cfg.ppo.gamma),
        )
        agent = make_agent(env, cfg.ppo, cfg.seed).to(cfg.device)
        trained = train_ppo(
            env,
            agent,
            relabel,
            cfg.ppo,
            steps=cfg.steps,
            seed=cfg.seed,
            run=run,
            termination=cfg.termination,
        )
        finish_run(
            run,
            cfg,
            agent,
            trained,
            expert=expert,
            demo=demo,
            reward=reward,
            seeds={"reward": reward_seed},
        )
