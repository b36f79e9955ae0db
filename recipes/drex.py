"""D-REX: a reward fitted to how noise worsens a cloned policy, which may exceed the demonstrator.

Demonstration -> cloned policy -> episodes ranked by their noise -> ensemble of rewards -> SAC or
PPO -> true score.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from torchrl.envs import Compose

from giril_rl.config.schema import FitConfig, OffPolicyRunConfig, ScalingConfig
from giril_rl.demos import holdout, subsample
from giril_rl.envs import make_env
from giril_rl.rewards.drex import DREXConfig, PreferenceLoss, drex_reward
from giril_rl.rewards.preferences import snippet_pairs
from giril_rl.training import (
    finish_run,
    fit_reward,
    make_algorithm,
    obtain_demonstration,
    open_run,
    return_scaling,
    train_policy,
)
from giril_rl.training.ranking import CloneConfig, RankingConfig, ranked_episodes
from giril_rl.transforms import IntrinsicReward


@dataclass
class Config(OffPolicyRunConfig):
    """What `giril run drex` takes."""

    scaling: ScalingConfig = field(default_factory=lambda: ScalingConfig(enabled=False))
    clone: CloneConfig = field(default_factory=CloneConfig)
    ranking: RankingConfig = field(default_factory=RankingConfig)
    reward: DREXConfig = field(default_factory=DREXConfig)
    # The authors' code.
    fit: FitConfig = field(default_factory=lambda: FitConfig(steps=3_000, batch=64, lr=1e-4))

    @property
    def reward_needs_actions(self) -> str | None:
        """What reads the demonstration's actions: the clone, whatever the reward reads."""
        return "this recipe clones: give one that has them, or take another recipe"


def main(cfg: Config, out: Path) -> None:
    """Train the whole chain and leave its run folder in ``out``."""
    with open_run(cfg, out, recipe=Path(__file__).stem) as run:
        if run.finished:
            return
        demo, expert = obtain_demonstration(cfg)
        pairs, validation = subsample(demo, cfg.demo.subsample), holdout(demo, cfg.demo.subsample)
        env = run.closing(make_env(cfg.task, cfg.learner.num_envs, cfg.seed))

        seed, settings = cfg.reward_seed, cfg.reward
        reward = drex_reward(settings, env, pairs, seed=seed).to(cfg.device)
        ranked = ranked_episodes(
            pairs,
            cfg.task,
            cfg.ranking,
            cfg.clone,
            seed=seed,
            run=run,
            validation=validation,
            device=cfg.device,
        )
        played = ranked.transitions
        reward.scaler.fit(played.get("observation"))
        fitted, unseen = snippet_pairs(
            ranked.noise,
            ranked.lengths,
            members=settings.members,
            pairs=settings.pairs,
            snippet=settings.snippet,
            margin=settings.margin,
            seed=seed,
        )
        loss = PreferenceLoss(reward, played, l2=settings.l2)
        fit_reward(loss, fitted, cfg.fit, seed=seed, run=run, validation=unseen)
        reward.calibrate(played)

        transform = Compose(IntrinsicReward(reward), *return_scaling(cfg))
        learner = make_algorithm(env, cfg, run=run, demo=demo, transform=transform)
        trained = train_policy(env, learner, transform, seed=cfg.seed, run=run)
        finish_run(
            run,
            cfg,
            learner.agent,
            trained,
            expert=expert,
            demo=demo,
            reward=reward,
            more={"ranking": ranked.summary()},
        )
