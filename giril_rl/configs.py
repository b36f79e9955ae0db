"""The typed knobs of every recipe, one dataclass for each part.

A field's type is what Hydra enforces, its default is the value used, its ``help`` is the line that
``giril run RECIPE --help`` shows, and its ``choices`` or bounds are what
:func:`giril_rl.validation.validate` checks. Nothing heavy is imported here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from omegaconf import MISSING


def knob(
    default: Any,
    help: str,
    *,
    choices: Sequence[str] | None = None,
    low: float | None = None,
    high: float | None = None,
    low_open: bool = False,
    high_open: bool = False,
) -> Any:
    """A dataclass field with a default, one line of help and what its value may be.

    Args:
        default: value used when nothing else is said; ``MISSING`` makes the knob mandatory.
        help: one line, shown by ``--help``.
        choices: the only texts allowed.
        low: smallest number allowed; in a list, of each entry.
        high: largest number allowed; in a list, of each entry.
        low_open: ``low`` itself is not allowed.
        high_open: ``high`` itself is not allowed.

    Examples:
        >>> from dataclasses import dataclass, fields
        >>> @dataclass
        ... class Part:
        ...     beta: float = knob(1.0, "a weight in (0, 1]", low=0, high=1, low_open=True)
        >>> Part().beta, fields(Part)[0].metadata["help"]
        (1.0, 'a weight in (0, 1]')
    """
    metadata = {
        "help": help,
        "choices": tuple(choices) if choices else None,
        "low": low,
        "high": high,
        "low_open": low_open,
        "high_open": high_open,
    }
    if isinstance(default, list):
        return field(default_factory=lambda: list(default), metadata=metadata)
    return field(default=default, metadata=metadata)


@dataclass
class TaskConfig:
    """The environment and what is known about it."""

    name: str = knob(MISSING, "name of the task, used for folders and tables")
    env_id: str = knob(MISSING, "Gymnasium id; vector observation, Box or Discrete actions")
    max_episode_steps: int | None = knob(
        None, "time limit; null takes the one registered for the id", low=1
    )
    steps: int = knob(1_000_000, "default policy steps for this task", low=1)
    expert_score: float | None = knob(None, "mean training return at which the expert stops early")


@dataclass
class PPOConfig:
    """Proximal policy optimisation, as the paper's continuous control experiments set it."""

    num_envs: int = knob(16, "parallel environments", low=1)
    rollout: int = knob(125, "steps per environment between updates", low=1)
    epochs: int = knob(10, "passes over each batch", low=1)
    minibatch: int = knob(250, "transitions per gradient step; divides num_envs * rollout", low=1)
    lr: float = knob(3e-4, "Adam step size", low=0, low_open=True)
    anneal_lr: bool = knob(False, "decrease the step size linearly to zero")
    clip: float = knob(0.1, "clipping range of the probability ratio", low=0, low_open=True)
    value_coef: float = knob(0.5, "weight of the squared value error", low=0)
    entropy_coef: float = knob(0.0, "weight of the entropy bonus", low=0)
    gamma: float = knob(0.99, "discount", low=0, high=1)
    lmbda: float = knob(0.95, "lambda of generalised advantage estimation", low=0, high=1)
    max_grad_norm: float = knob(
        0.5, "gradient norm above which gradients are scaled down", low=0, low_open=True
    )
    hidden: list[int] = knob([100, 100], "hidden layers of policy and value network (tanh)", low=1)
    normalise_observations: bool = knob(True, "running observation normalisation, clipped at 10")
    checkpoint_every: int = knob(100_000, "environment steps between checkpoints", low=1)


@dataclass
class ExpertConfig:
    """The player whose demonstration is imitated: PPO on the true reward."""

    steps: int = knob(5_000_000, "most environment steps of expert training (paper: 5M)", low=1)
    seed: int = knob(0, "seed of the expert, separate from the policy's", low=0)
    stop_early: bool = knob(True, "stop once the mean return reaches task.expert_score")
    path: str | None = knob(None, "folder of a finished expert run to use instead of training one")


@dataclass
class DemoConfig:
    """What is recorded from the expert and how much of it is used."""

    path: str | None = knob(None, "folder of a demonstration to use instead of recording one")
    length: int | None = knob(
        1000, "transitions to record; null records `episodes` whole episodes", low=1
    )
    episodes: int | None = knob(None, "whole episodes to record (then length must be null)", low=1)
    deterministic: bool = knob(True, "play the expert's mean action rather than a sampled one")
    seed: int = knob(0, "seed of the recorded episodes", low=0)
    subsample: int = knob(20, "keep 1 in k transitions, fixed once (paper: 20; 1 keeps all)", low=1)


@dataclass
class GenerativeConfig:
    """GIRIL's conditional VAE and the reward made of it."""

    beta: float = knob(
        1.0,
        "weight of the true action against the encoded one, in (0, 1]",
        low=0,
        high=1,
        low_open=True,
    )
    alpha: float | None = knob(
        None, "weight of the action term; null: 1 for Box, 100 for Discrete", low=0
    )
    scale: float = knob(1.0, "lambda, the weight of the squared error", low=0, low_open=True)
    prior: str = knob(
        "standard",
        "latent prior: standard N(0, I) or conditional p(z | s)",
        choices=("standard", "conditional"),
    )
    normalise: str = knob(
        "standardise",
        "observation rule of the reward model",
        choices=("demo_range", "standardise", "raw"),
    )
    clamp: bool = knob(True, "clamp normalised observations to [-1, 1]")
    hidden: list[int] = knob([100, 100], "hidden layers of encoder and decoder (tanh)", low=1)
    seed: int | None = knob(None, "seed of the reward model; null takes the run's seed", low=0)


@dataclass
class FitConfig:
    """Training of a reward model on the demonstration."""

    steps: int = knob(50_000, "gradient steps", low=0)
    batch: int = knob(32, "transitions per gradient step", low=1)
    lr: float = knob(3e-5, "Adam step size", low=0, low_open=True)
    log_every: int = knob(500, "gradient steps between logged losses", low=1)


@dataclass
class ScalingConfig:
    """Division of rewards by the running deviation of their discounted return."""

    enabled: bool = knob(True, "scale the reward")
    reset: str = knob(
        "never", "when to forget the running return of an episode", choices=("never", "done")
    )
    clip: float | None = knob(
        10.0, "clip scaled rewards to plus or minus this; null does not", low=0, low_open=True
    )


@dataclass
class EvalConfig:
    """Scoring on fresh environments, whole episodes, true reward."""

    episodes: int = knob(20, "episodes for each of the deterministic and the sampled policy", low=1)
    seed: int = knob(10_000, "seed of the evaluation episodes", low=0)


@dataclass
class RunConfig:
    """What all recipes share."""

    task: TaskConfig = field(default_factory=TaskConfig)
    profile: str = knob(
        "released",
        "released (reward averaged over environments) or paper (eq. 2)",
        choices=("released", "paper"),
    )
    batch_mean: bool = knob(
        True, "average each step's reward over the environments (profile released)"
    )
    seed: int = knob(0, "seed of the policy's training", low=0)
    steps: int = knob(MISSING, "policy environment steps", low=1)
    out: str | None = knob(
        None, "the run's folder; null makes a name from recipe, task and changes"
    )
    root: str = knob("runs", "where runs, experts and demonstrations are kept")
    logger: str | None = knob(
        "tensorboard",
        "where curves go besides the run's own files; null nowhere",
        choices=("tensorboard", "csv", "wandb", "mlflow"),
    )
    threads: int = knob(1, "torch threads; small networks are fastest with 1", low=1)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    eval: EvalConfig = field(default_factory=EvalConfig)


@dataclass
class ExpertRunConfig(RunConfig):
    """What the expert's own recipe takes: PPO on the true reward."""

    steps: int = knob(5_000_000, "most environment steps of expert training (paper: 5M)", low=1)
    stop_early: bool = knob(True, "stop once the mean return reaches task.expert_score")
    scaling: ScalingConfig = field(default_factory=lambda: ScalingConfig(reset="done"))
