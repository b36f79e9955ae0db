"""BC: a policy fitted to the demonstration's actions; no reward, and no environment to learn in.

Demonstration -> behaviour cloning -> score on the true reward. It takes no environment steps
(`steps=0`): `bc.steps` counts gradient steps. Of `ppo`, only `hidden` and `normalise_observations`
are used; `task.horizon` changes nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from giril_rl.config.schema import BCConfig, DemoRunConfig, knob
from giril_rl.demos import holdout, subsample
from giril_rl.envs import make_env
from giril_rl.training import (
    clone_behaviour,
    finish_run,
    make_agent,
    obtain_demonstration,
    open_run,
)


@dataclass
class Config(DemoRunConfig):
    """What `giril run bc` takes."""

    steps: int = knob(0, "environment steps: cloning takes none", low=0)
    bc: BCConfig = field(default_factory=BCConfig)


def main(cfg: Config, out: Path) -> None:
    """Train the whole chain and leave its run folder in ``out``."""
    with open_run(cfg, out, recipe=Path(__file__).stem) as run:
        if run.finished:
            return
        demo, expert = obtain_demonstration(cfg)
        pairs, validation = subsample(demo, cfg.demo.subsample), holdout(demo, cfg.demo.subsample)

        env = run.closing(make_env(cfg.task, 1, cfg.seed))
        agent = make_agent(env, cfg.ppo, cfg.seed).to(cfg.device)
        env.close()
        trained = clone_behaviour(
            agent, pairs, cfg.bc, seed=cfg.seed, run=run, validation=validation
        )
        finish_run(run, cfg, agent, trained, expert=expert, demo=demo)
