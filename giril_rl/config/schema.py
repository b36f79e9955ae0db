"""The settings of every recipe, one dataclass for each part.

Hydra enforces a field's type; :func:`giril_rl.config.validation.validate` checks its bounds and
choices and calls ``check`` of a class that has it; ``giril run RECIPE --help`` shows its line of
help. Nothing heavy is imported here.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from omegaconf import MISSING

from giril_rl.config.families import TaskFamily, family_of
from giril_rl.config.knobs import default_text, knob
from giril_rl.errors import UserError
from giril_rl.moved import forwarding

MOST_THREADS = 1024
USE_ACTIONS = "read actions; false reads states alone, as a demonstration without actions needs"
COMPILE = "torch.compile of gradient steps: for long training on frames, 20 seconds to begin"


def split_id(env_id: str) -> tuple[str | None, str]:
    """The module that registers an id, where it is named as Gymnasium has it, and the id proper.

    Examples:
        >>> split_id("my_envs:Ball-v0"), split_id("Pendulum-v1")
        (('my_envs', 'Ball-v0'), (None, 'Pendulum-v1'))
    """
    module, colon, name = env_id.rpartition(":")
    return (module if colon else None), name


@dataclass
class TaskConfig:
    """The environment and what is known about it."""

    name: str = knob(MISSING, "name of the task, used for folders and tables")
    env_id: str = knob(
        MISSING,
        "Gymnasium id, or MODULE:ID of a module of yours; vector observation or ALE/..., Box or "
        "Discrete",
    )
    max_episode_steps: int | None = knob(
        None, "time limit; null takes the one registered for the id (Atari: 27,000)", low=1
    )
    steps: int = knob(1_000_000, "default policy steps for this task", low=1)
    demonstration: str | None = knob(
        None, "default of demo.path, unless the demonstration, expert or recording is chosen"
    )
    expert_score: float | None = knob(None, "mean training return at which the expert stops early")
    expert_steps: int = knob(
        5_000_000, "most environment steps of the task's expert (paper: 5M)", low=1
    )
    horizon: str = knob(
        "own",
        "own: a failure ends an episode; fixed: only the time limit does (in policy training)",
        choices=("own", "fixed"),
    )
    after_failure: str = knob(
        "reset",
        "horizon=fixed: reset the simulator unnoticed, or continue from where it failed",
        choices=("reset", "continue"),
    )
    episode: str = knob(
        "life",
        "Atari: a lost life ends an episode of training, or only the game's end does",
        choices=("life", "game"),
    )

    @property
    def family(self) -> TaskFamily:
        """What is known of the environment by its id alone."""
        return family_of(self.env_id)

    def check(self, prefix: str, run: object) -> None:
        """Refuses settings of another kind of task; see :func:`.validation.validate`."""
        if self.horizon != "own" and not self.family.fixed_horizon:
            raise UserError(
                f"{prefix}horizon={self.horizon} is for vector tasks: leave {prefix}horizon=own."
            )
        if self.episode != "life" and not self.family.has_lives:
            raise UserError(
                f"{prefix}episode={self.episode} is for games, whose lives end episodes: leave "
                f"{prefix}episode=life."
            )
        if self.after_failure != "reset" and self.horizon == "own":
            raise UserError(
                f"{prefix}after_failure={self.after_failure} means nothing where a failure ends "
                f"the episode: add {prefix}horizon=fixed."
            )


class _Batches:
    """What the settings of all algorithms share."""

    num_envs: int
    rollout: int

    def whole_batches(self, steps: int) -> int:
        """``steps``, rounded up to the end of a batch.

        Examples:
            >>> PPOConfig(num_envs=16, rollout=125).whole_batches(15_000)
            16000
        """
        batch = self.num_envs * self.rollout
        return -(-steps // batch) * batch


@dataclass
class PPOConfig(_Batches):
    """Proximal policy optimisation, as the paper's continuous control experiments set it."""

    num_envs: int = knob(16, "parallel environments", low=1)
    rollout: int = knob(125, "steps per environment between updates", low=1)
    epochs: int = knob(10, "passes over each batch", low=1)
    minibatch: int = knob(250, "transitions per gradient step; divides num_envs * rollout", low=1)
    lr: float = knob(3e-4, "Adam step size", low=0, low_open=True)
    anneal_lr: bool = knob(False, "decrease the step size linearly to zero")
    clip: float = knob(0.1, "clipping range of the probability ratio", low=0, low_open=True)
    value_coef: float = knob(0.5, "weight of the squared value error", low=0)
    clip_value: bool = knob(False, "clip the change of the value by the same range (Atari)")
    entropy_coef: float = knob(0.0, "weight of the entropy bonus", low=0)
    gamma: float = knob(0.99, "discount", low=0, high=1)
    lmbda: float = knob(0.95, "lambda of generalised advantage estimation", low=0, high=1)
    max_grad_norm: float = knob(
        0.5, "gradient norm above which gradients are scaled down", low=0, low_open=True
    )
    hidden: list[int] = knob([100, 100], "hidden layers of policy and value network (tanh)", low=1)
    normalise_observations: bool = knob(True, "running observation normalisation, clipped at 10")
    checkpoint_every: int = knob(100_000, "environment steps between checkpoints", low=1)
    compile: bool = knob(False, f"{COMPILE}; of the acting policy as well")

    def check(self, prefix: str, run: object) -> None:
        """Refuses a minibatch that does not divide the batch."""
        batch = self.num_envs * self.rollout
        if batch % self.minibatch:
            raise UserError(
                f"{prefix}minibatch={self.minibatch} does not divide {prefix}num_envs * "
                f"{prefix}rollout = {self.num_envs} * {self.rollout} = {batch}: choose one that "
                "does."
            )


@dataclass
class SACConfig(_Batches):
    """Soft actor-critic: off-policy, from a replay buffer that may begin with the demonstration."""

    num_envs: int = knob(8, "parallel environments", low=1)
    rollout: int = knob(8, "steps per environment between updates", low=1)
    updates: float = knob(
        0.5, "gradient steps for each environment step", low=0, low_open=True, high=64
    )
    batch: int = knob(128, "transitions per gradient step", low=1)
    lr: float = knob(1e-3, "Adam step size of actor, critics and temperature", low=0, low_open=True)
    gamma: float = knob(0.99, "discount", low=0, high=1)
    tau: float = knob(
        0.005, "how far target critics move to the critics each step", low=0, low_open=True, high=1
    )
    hidden: list[int] = knob([128, 128], "hidden layers of actor and critics (ReLU)", low=1)
    normalise_observations: bool = knob(False, "running observation normalisation, clipped at 10")
    entropy: str = knob(
        "tuned",
        "tuned: the temperature holds target_entropy; fixed: it stays; none: a deterministic actor "
        "(discrete: without a bonus) that explores with fixed noise",
        choices=("tuned", "fixed", "none"),
    )
    temperature: float = knob(
        1.0, "initial temperature of the entropy bonus, or the fixed one", low=0, low_open=True
    )
    target_entropy: float | None = knob(
        None,
        "entropy=tuned: null takes minus the number of action dimensions; discrete: 0.98 of the "
        "most that there is",
    )
    noise: float = knob(
        0.1,
        "entropy=none: standard deviation of the noise, before squashing to the bounds",
        low=0,
        low_open=True,
    )
    time_aware_critic: bool = knob(
        False,
        "the critics also see gamma^t, t the episode's steps so far, the actor does not: for "
        "rewards that depend on what the episode visited before, such as PWIL's",
    )
    random_steps: int = knob(1_000, "environment steps of random actions before learning", low=0)
    buffer_size: int = knob(1_000_000, "transitions in the replay buffer, on disk", low=1)
    demonstration: str = knob(
        "seed",
        "in the replay: seed adds its transitions to the agent's; half makes them half of each "
        "minibatch; none leaves them out",
        choices=("seed", "half", "none"),
    )
    checkpoint_every: int = knob(20_000, "environment steps between checkpoints", low=1)
    log_every: int = knob(1_000, "environment steps between rows of metrics", low=1)
    precision: str = knob(
        "fp32",
        "bf16: products between hidden layers are of bfloat16 numbers: pays for layers of 256 on "
        "processors that have them",
        choices=("fp32", "bf16"),
    )
    compile: bool = knob(
        False,
        "torch.compile of whole gradient steps and of the acting policy: pays from some 20,000 "
        "steps on; 10 to 40 seconds to begin",
    )

    def check(self, prefix: str, run: object) -> None:
        """Refuses a precision of products that there are none of."""
        if self.precision == "bf16" and len(self.hidden) < 2:
            raise UserError(
                f"{prefix}precision=bf16 is of products between hidden layers, and "
                f"{prefix}hidden={self.hidden} is one: give two or more, or leave the precision "
                "out."
            )


def idle_algorithm(algorithm: object) -> str:
    """The algorithm that does not run beside the chosen one: its settings are not read.

    Examples:
        >>> idle_algorithm("sac")
        'ppo'
    """
    return "ppo" if algorithm == "sac" else "sac"


@dataclass
class ExpertConfig:
    """The player whose demonstration is imitated: PPO on the true reward."""

    steps: int | None = knob(
        None, "most environment steps of expert training; null takes task.expert_steps", low=1
    )
    seed: int | None = knob(None, "seed of the expert; null takes the run's seed", low=0)
    stop_early: bool = knob(True, "stop once the mean return reaches task.expert_score")
    path: str | None = knob(None, "folder of a finished expert run to use instead of training one")

    def steps_on(self, task: TaskConfig) -> int:
        """Most environment steps of this expert's training on ``task``."""
        return task.expert_steps if self.steps is None else self.steps


@dataclass
class DemoConfig:
    """The demonstration: what is recorded from the expert, and how much of it is used."""

    path: str | None = knob(
        None,
        "folder of a demonstration to use; `shipped` takes the package's own, the one of the run's "
        "seed, `shipped:NAME/2` a given one; null records one; the task decides by default",
    )
    length: int | None = knob(
        1000, "transitions to record; null records `episodes` whole episodes", low=1
    )
    episodes: int | None = knob(
        None,
        "whole episodes to record (then length must be null), or to take of one given by `path`",
        low=1,
    )
    first: int | None = knob(
        None, "use the first n transitions alone, before `subsample`; null uses all", low=2
    )
    lives: str = knob(
        "first",
        "Atari: an episode goes up to the first lost life, or through all lives",
        choices=("first", "all"),
    )
    deterministic: bool = knob(True, "play the expert's mean action rather than a sampled one")
    seed: int | None = knob(None, "seed of the recorded episodes; null takes the run's seed", low=0)
    subsample: int = knob(20, "keep 1 in k transitions, fixed once (paper: 20; 1 keeps all)", low=1)

    def check(self, prefix: str, run: object) -> None:
        """Refuses two lengths, none, or more than there will be."""
        length, episodes = default_text(self.length), default_text(self.episodes)
        if self.path is None and (self.length is None) == (self.episodes is None):
            raise UserError(
                f"{prefix}length={length} and {prefix}episodes={episodes}: give exactly one of "
                "them and set the other to null."
            )
        if self.path is None and self.length is not None and (self.first or 0) > self.length:
            raise UserError(
                f"{prefix}first={self.first} is more than {prefix}length={length}: record more, or "
                "use fewer."
            )
        for name in ("first", "length"):
            most = getattr(self, name)
            if most is not None and self.subsample > most:
                raise UserError(
                    f"{prefix}subsample={self.subsample} leaves nothing of {prefix}{name}={most}: "
                    "choose a smaller one."
                )


@dataclass
class FitConfig:
    """Training of a reward model on the demonstration."""

    steps: int = knob(50_000, "gradient steps", low=0)
    batch: int = knob(32, "transitions per gradient step", low=1)
    lr: float = knob(3e-5, "Adam step size", low=0, low_open=True)
    log_every: int = knob(500, "gradient steps between logged losses", low=1)
    compile: bool = knob(False, COMPILE)


@dataclass
class BCConfig:
    """Behaviour cloning: the policy fitted to the demonstrated actions."""

    stop: str = knob(
        "held_out",
        "held_out: keep the weights that are best on held-out transitions; fixed: the last ones",
        choices=("held_out", "fixed"),
    )
    steps: int = knob(5_000, "gradient steps", low=1)
    batch: int = knob(
        100, "transitions per gradient step; where there are no more, all of them", low=1
    )
    lr: float = knob(3e-3, "AdamW step size, decreasing linearly to zero", low=0, low_open=True)
    weight_decay: float = knob(1.0, "AdamW's weight decay, times the step size", low=0)
    min_scale: float = knob(
        0.07, "smallest standard deviation that observations are divided by", low=0
    )
    min_std: float = knob(
        0.01,
        "Box: smallest standard deviation of sampled actions, in units of half their range",
        low=0,
        low_open=True,
    )
    log_every: int = knob(
        100, "gradient steps between logged losses, where held-out ones are compared", low=1
    )

    def check(self, prefix: str, run: Any) -> None:
        """Refuses environment steps, and early stopping without validation pairs."""
        if run.steps:
            raise UserError(
                f"steps={run.steps}: cloning takes no environment steps; leave steps=0, "
                f"{prefix}steps is the number of gradient steps."
            )
        if run.algorithm != "ppo":
            raise UserError(
                f"algorithm={run.algorithm}: cloning is no reinforcement learning; leave it out."
            )
        self.check_validation(prefix, run)

    def check_validation(self, prefix: str, run: Any) -> None:
        """Refuses early stopping without validation pairs."""
        if self.stop == "held_out" and run.demo.subsample == 1:
            raise UserError(
                f"{prefix}stop=held_out needs transitions to hold out and demo.subsample=1 leaves "
                f"none: set demo.subsample to at least 2, or {prefix}stop=fixed."
            )


@dataclass
class ScalingConfig:
    """Division of rewards by the running standard deviation of their discounted return."""

    enabled: bool = knob(True, "scale the reward")
    reset: str = knob(
        "never", "when to forget the running return of an episode", choices=("never", "done")
    )
    clip: float | None = knob(
        10.0, "clip scaled rewards to plus or minus this; null does not", low=0, low_open=True
    )


@dataclass
class EvalConfig:
    """Evaluation on fresh environments: whole episodes, true reward."""

    episodes: int = knob(20, "episodes for each of the deterministic and the sampled policy", low=1)
    seed: int = knob(10_000, "seed of the evaluation episodes", low=0)


@dataclass
class RunConfig:
    """Settings of every recipe."""

    task: TaskConfig = field(default_factory=TaskConfig)
    seed: int = knob(0, "seed of the policy's training", low=0)
    steps: int = knob(MISSING, "policy environment steps", low=1)
    out: str | None = knob(
        None, "the run's folder; null makes a name from recipe, task and changes"
    )
    root: str = knob("runs", "where runs, experts and demonstrations are kept")
    imports: list[str] = knob(
        [], "modules of yours that register environments; found here and beside the recipe"
    )
    logger: str | None = knob(
        "tensorboard",
        "where curves go besides the run's own files; null nowhere",
        choices=("tensorboard", "csv", "wandb", "mlflow"),
    )
    threads: int = knob(
        1, "torch threads; small networks are fastest with 1", low=1, high=MOST_THREADS
    )
    device: str = knob(
        "cpu",
        "where networks and batches are; environments stay on the CPU",
        choices=("cpu", "cuda"),
    )
    algorithm: str = knob(
        "ppo", "what learns from the reward: on-policy or off-policy", choices=("ppo", "sac")
    )
    ppo: PPOConfig = field(default_factory=PPOConfig)
    sac: SACConfig = field(default_factory=SACConfig)
    eval: EvalConfig = field(default_factory=EvalConfig)

    @property
    def learner(self) -> PPOConfig | SACConfig:
        """The settings of the chosen algorithm."""
        return self.sac if self.algorithm == "sac" else self.ppo


@dataclass
class ExpertRunConfig(RunConfig):
    """What the expert's own recipe takes: PPO on the true reward."""

    steps: int = knob(5_000_000, "most environment steps of expert training (paper: 5M)", low=1)
    stop_early: bool = knob(True, "stop once the mean return reaches task.expert_score")
    clip_reward: bool = knob(False, "learn from the reward's sign (Atari); scores are unclipped")
    scaling: ScalingConfig = field(default_factory=lambda: ScalingConfig(reset="done"))


@dataclass
class DemoRunConfig(RunConfig):
    """What recipes share that learn from a demonstration."""

    expert: ExpertConfig = field(default_factory=ExpertConfig)
    demo: DemoConfig = field(default_factory=DemoConfig)

    @property
    def needs_demonstration(self) -> bool:
        """Whether the run learns from a demonstration, and so from an expert."""
        return True

    @property
    def needs_actions(self) -> str | None:
        """What reads the demonstration's actions, and what to set if it has none; None: nothing."""
        return self.reward_needs_actions or replay_needs_actions(self)

    @property
    def reward_needs_actions(self) -> str | None:
        """The same of the reward alone, or of the policy where there is no reward."""
        return needs_actions("reward", getattr(self, "reward", None))


def needs_actions(name: str, reward: object) -> str | None:
    """What of a reward's settings, under the key ``name``, reads actions, and what to set.

    Examples:
        >>> needs_actions("reward", None)
        'this recipe learns from: give one that has them, or take another recipe'
    """
    uses = getattr(reward, "use_actions", None)
    if uses is None:
        return "this recipe learns from: give one that has them, or take another recipe"
    return f"{name}.use_actions=true reads: set {name}.use_actions=false" if uses else None


def replay_needs_actions(run: RunConfig) -> str | None:
    """The same of SAC's replay buffer; None where the demonstration is not put there."""
    chosen = run.sac.demonstration
    if run.algorithm != "sac" or chosen == "none":
        return None
    return f"sac.demonstration={chosen} puts into the replay: set sac.demonstration=none"


@dataclass
class RewardRunConfig(DemoRunConfig):
    """What recipes share that train a policy on a reward of the demonstration."""

    scaling: ScalingConfig = field(default_factory=ScalingConfig)
    termination: str = knob(
        "ends",
        "ends: nothing follows a failure; bootstrap: its value continues, as after a time limit",
        choices=("ends", "bootstrap"),
    )

    @property
    def reward_seed(self) -> int:
        """Seed of the reward model: ``reward.seed``, or the run's."""
        own = getattr(getattr(self, "reward", None), "seed", None)
        return self.seed if own is None else own


@dataclass
class OffPolicyRunConfig(RewardRunConfig):
    """What recipes share whose reward asks for an off-policy learner and the whole demonstration.

    On frames, for which SAC has no networks, the defaults of Atari tasks choose PPO.
    """

    algorithm: str = knob(
        "sac", "what learns from the reward: on-policy or off-policy", choices=("ppo", "sac")
    )
    demo: DemoConfig = field(default_factory=lambda: DemoConfig(subsample=1))


@dataclass
class AveragedRunConfig(RewardRunConfig):
    """What recipes share whose reward may be averaged over the environments."""

    profile: str = knob(
        "released",
        "released (reward averaged over environments) or paper (eq. 2)",
        choices=("released", "paper"),
    )
    batch_mean: bool = knob(
        True, "average each step's reward over the environments (profile released)"
    )


@dataclass
class UnaveragedRunConfig(RunConfig):
    """Deprecated, for recipes that were copied from version 0.1: take :class:`RunConfig`."""

    profile: str = knob("released", "no effect", choices=("released", "paper"))
    batch_mean: bool = knob(True, "no effect")
    termination: str = knob("ends", "no effect here", choices=("ends", "bootstrap"))


__getattr__ = forwarding(__name__)  # Names of version 0.1.
