"""BC: a policy fitted to the demonstration's actions; no reward, and no environment to learn in.

Expert -> demonstration -> behaviour cloning -> score on the true reward. It takes no environment
steps (`steps=0`): `bc.steps` counts gradient steps. Of `ppo`, only `hidden` and
`normalise_observations` are used; `profile`, `task.horizon` and `termination` change nothing.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path

from giril_rl.config.schema import BCConfig, DemoConfig, ExpertConfig, UnaveragedRunConfig, knob
from giril_rl.demos import holdout, subsample
from giril_rl.envs import make_env
from giril_rl.training import (
    Run,
    check_inputs,
    clone_behaviour,
    finish_run,
    make_agent,
    obtain_demonstration,
)


@dataclass
class Config(UnaveragedRunConfig):
    """What `giril run bc` takes."""

    steps: int = knob(0, "environment steps: cloning takes none", low=0)
    expert: ExpertConfig = field(default_factory=ExpertConfig)
    demo: DemoConfig = field(default_factory=DemoConfig)
    bc: BCConfig = field(default_factory=BCConfig)


def main(cfg: Config, out: Path) -> None:
    """Train the whole chain and leave its run folder in ``out``."""
    check_inputs(cfg, cfg.expert, cfg.demo)
    with Run.open(out, asdict(cfg), recipe=Path(__file__).stem, logger=cfg.logger) as run:
        if run.finished:
            return
        demo, expert = obtain_demonstration(cfg, cfg.expert, cfg.demo)
        env = run.closing(make_env(cfg.task, 1, cfg.seed))

        agent = make_agent(env, cfg.ppo, cfg.seed).to(cfg.device)
        env.close()
        trained = clone_behaviour(
            agent,
            subsample(demo, cfg.demo.subsample),
            cfg.bc,
            seed=cfg.seed,
            run=run,
            held_out=holdout(demo, cfg.demo.subsample),
        )
        finish_run(
            run,
            cfg,
            agent,
            trained,
            expert=expert,
            demo=demo,
        )
