"""Control: PPO on a stand-in for a learned reward, or the score of a policy that never learned.

A learned reward has shown something only where it does better than these.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from torchrl.envs import Compose

from giril_rl.envs import make_env
from giril_rl.methods import ControlRunConfig, control_reward
from giril_rl.training import (
    HeldAction,
    RandomPolicy,
    Run,
    Trained,
    check_discrete,
    check_inputs,
    check_task,
    finish_run,
    held_action_scores,
    make_agent,
    obtain_demonstration,
    return_scaling,
    train_ppo,
)
from giril_rl.transforms import BatchMeanReward, IntrinsicReward


@dataclass
class Config(ControlRunConfig):
    """What `giril run control` takes."""


def main(cfg: Config, out: Path) -> None:
    """Train a policy on the control reward and leave its run folder in ``out``."""
    if cfg.needs_demonstration:
        check_inputs(cfg, cfg.expert, cfg.demo)
    else:
        check_task(cfg)
    player: RandomPolicy | HeldAction | None = None
    if cfg.reward == "random":
        player = RandomPolicy.of_task(cfg.task, cfg.seed)
    if cfg.reward == "held_action":
        check_discrete(cfg.task)
    with Run.open(out, asdict(cfg), recipe=Path(__file__).stem, logger=cfg.logger) as run:
        if run.finished:
            return
        if cfg.reward == "held_action":
            # Chosen in episodes of the training's seed, scored in those of the evaluation's.
            scores = held_action_scores(cfg.task, episodes=cfg.held_episodes, seed=cfg.seed)
            run.truncate_metrics("held_action", -1)
            for action, score in enumerate(scores):
                run.log(action, {"held_action/return_mean": score}, phase="held_action")
            player = HeldAction.of_task(cfg.task, scores.index(max(scores)))
        if player is not None:
            finish_run(run, cfg, player, Trained(0, 0.0))
            return
        demo, expert = None, None
        if cfg.needs_demonstration:
            demo, expert = obtain_demonstration(cfg, cfg.expert, cfg.demo)
        env = run.closing(make_env(cfg.task, cfg.ppo.num_envs, cfg.seed))

        reward, seeds = control_reward(cfg, env, demo, run)

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
            seeds=seeds,
        )
