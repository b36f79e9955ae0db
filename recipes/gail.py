"""GAIL: a reward from a discriminator trained beside the policy that maximises it.

Expert -> demonstration -> discriminator <-> PPO on its reward -> score on the true reward.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path

from torchrl.envs import Compose

from giril_rl.config.schema import (
    DemoConfig,
    ExpertConfig,
    ScalingConfig,
    UnaveragedRunConfig,
)
from giril_rl.demos import subsample
from giril_rl.envs import make_env
from giril_rl.rewards import AdversarialConfig, DiscriminatorLoss, discriminator_reward
from giril_rl.training import (
    AdversarialLearner,
    Run,
    check_inputs,
    finish_run,
    make_agent,
    obtain_demonstration,
    return_scaling,
    train_ppo,
)
from giril_rl.transforms import IntrinsicReward


@dataclass
class Config(UnaveragedRunConfig):
    """What `giril run gail` takes."""

    expert: ExpertConfig = field(default_factory=ExpertConfig)
    demo: DemoConfig = field(default_factory=DemoConfig)
    reward: AdversarialConfig = field(default_factory=AdversarialConfig)
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
        reward = discriminator_reward(cfg.reward, env, pairs, seed=reward_seed).to(cfg.device)
        learner = AdversarialLearner(
            DiscriminatorLoss(reward, penalty=cfg.reward.penalty),
            pairs,
            cfg.reward,
            seed=reward_seed,
        )

        relabel = Compose(
            IntrinsicReward(reward),
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
            learn_reward=learner,
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
