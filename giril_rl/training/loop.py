"""The training loop of every recipe: collect, relabel, learn, log, checkpoint, resume."""

from __future__ import annotations

import contextlib
import time
import warnings
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.collectors import Collector

from giril_rl.envs import BatchedEnv
from giril_rl.policies.making import check_actions
from giril_rl.runs.checkpoint import refusing_misfits
from giril_rl.runs.finite_checks import Finite
from giril_rl.runs.interrupt import Interrupt, Interrupted
from giril_rl.runs.metrics import MetricMeans
from giril_rl.runs.progress import progress
from giril_rl.runs.randomness import Use, restore_rng, rng_state, stream_seed
from giril_rl.runs.run import Run
from giril_rl.training.algorithm import Algorithm
from giril_rl.training.episodes import EpisodeTracker
from giril_rl.training.reward_trainers import RewardTrainer
from giril_rl.transforms.batch_mean import BatchMeanReward
from giril_rl.transforms.scaling import NonFiniteReward, ReturnScaling

RECENT_EPISODES = 20
"""Training episodes whose mean true return decides about an expert's early stop."""


@dataclass
class Trained:
    """What a training was.

    Attributes:
        steps: environment steps.
        seconds: wall-clock seconds, those of earlier processes included.
        inexact_resumes: how often it was resumed without its running episodes.
        averaged: whether rewards were averaged over the environments.
        stopped: whether it ended early.
    """

    steps: int = 0
    seconds: float = 0.0
    inexact_resumes: int = 0
    averaged: bool = False
    stopped: bool = False


def train_policy(
    env: BatchedEnv,
    algorithm: Algorithm,
    transform: nn.Module,
    *,
    seed: int,
    run: Run,
    phase: str | None = None,
    reward_trainer: RewardTrainer | None = None,
    stop_at: float | None = None,
    use: Use = "training",
) -> Trained:
    """Trains ``algorithm.agent`` on the reward that ``transform`` writes; resumes by itself.

    The environment's own reward is logged before ``transform`` replaces it. Nothing that learns
    reads it. A checkpoint holds all that the rest of the run depends on, the simulators' state
    included, so that an interrupted run ends with the same weights. Where a simulator does not
    repeat itself, the run continues with fresh episodes, and says so.

    Args:
        env: the training environments; closed at the end, whatever happens.
        algorithm: what learns, such as :class:`~giril_rl.training.ppo.PPO`.
        transform: a TorchRL transform or a composition of them, called with each batch
            ``(num_envs, time)``; its ``state_dict`` is checkpointed.
        seed: seeds action sampling and minibatch order.
        run: where metrics and checkpoints go.
        phase: name of the checkpoint and of the metrics; None takes the algorithm's.
        reward_trainer: trains the reward model on each batch before ``transform`` uses it.
        stop_at: ends training once the mean true return of the last 20 training episodes reaches
            this. Only an expert, which may see the true reward, is trained with it.
        use: what the random numbers are for: "training", or "player" for an expert.

    Returns:
        Environment steps, seconds and inexact resumes, those of earlier processes included.

    Raises:
        UserError: if the agent was made for other actions than the environment's.
        Interrupted: after a checkpoint, if the user asked for it with Ctrl-C.
        RunError: if a loss or a weight is no longer finite; the last checkpoint stays.
    """
    with contextlib.ExitStack() as stack:
        stack.callback(_close, env)
        check_actions(algorithm.agent, env)
        transform.to(algorithm.agent.device)
        phase = phase or algorithm.name
        session = _Session(algorithm, transform, reward_trainer, run, phase)
        saved = session.begin()
        if saved is not None and session.is_over:
            session.restore(saved)
            algorithm.close()
            return session.trained
        exact = saved is None or session.restore_simulators(env, saved)
        left = algorithm.steps - session.trained.steps
        collector = _collector(env, algorithm, left)
        stack.callback(collector.shutdown)
        # Only now, for making a collector may draw random numbers.
        torch.manual_seed(stream_seed(use, seed))
        if saved is not None:
            session.restore(saved)
            with refusing_misfits(run, phase):
                restore_rng(saved["rng"])
        if not exact:
            session.forget_episodes()
        return _train(session, collector, env, stop_at)


def _train(
    session: _Session, collector: Collector, env: BatchedEnv, stop_at: float | None
) -> Trained:
    """Goes through the collector's batches, to the end, an early stop or Ctrl-C."""
    trained, algorithm, run = session.trained, session.algorithm, session.run
    every = algorithm.checkpoint_every
    run.truncate_metrics(session.phase, trained.steps)
    next_save = (trained.steps // every + 1) * every
    began = time.perf_counter() - trained.seconds
    with (
        Interrupt() as interrupt,
        progress(algorithm.steps, trained.steps, session.phase) as bar,
    ):
        for batch in _on_one_thread(collector) if env.has_threads else collector:
            session.learn(batch)
            bar.update(batch.numel(), true_return=session.shown_return)
            trained.stopped = stop_at is not None and session.recent_return >= stop_at
            if trained.steps >= next_save or session.is_over or interrupt.requested:
                next_save += every
                trained.seconds = time.perf_counter() - began
                session.save(env)
            if trained.stopped or interrupt.requested:
                break
    if session.is_over:
        algorithm.close()
    if interrupt.requested:  # At the end as well, for the run may have more to do.
        whose = "player" if run.recipe == "expert" else "policy"
        part = f"the {whose}'s training"
        raise Interrupted.at(trained.steps, algorithm.steps, part=part, most=stop_at is not None)
    return trained


@dataclass
class _Session:
    """All that a checkpoint of the training holds, and one step of it."""

    algorithm: Algorithm
    transform: nn.Module
    reward_trainer: RewardTrainer | None
    run: Run
    phase: str
    trained: Trained = field(default_factory=Trained)
    recent: deque[float] = field(default_factory=lambda: deque(maxlen=RECENT_EPISODES))
    shown_return: str = "?"

    def __post_init__(self) -> None:
        parts = self.transform.modules()
        self.trained.averaged = any(isinstance(part, BatchMeanReward) for part in parts)
        self.tracker = EpisodeTracker(self.algorithm.num_envs)
        self.finite = Finite(self.run.folder, self.algorithm.steps)
        self.means = MetricMeans(totals=["train/episodes"])

    @property
    def is_over(self) -> bool:
        """Whether all steps are taken, or an early stop came."""
        return self.trained.steps >= self.algorithm.steps or self.trained.stopped

    @property
    def recent_return(self) -> float:
        """Mean true return of the last episodes; minus infinity before there are enough."""
        if len(self.recent) < RECENT_EPISODES:
            return float("-inf")
        return sum(self.recent) / RECENT_EPISODES

    def learn(self, collected: TensorDictBase) -> None:
        """One batch: trains the reward model, relabels, updates the policy, and logs."""
        started = time.perf_counter()
        returns, lengths = self.tracker(collected)
        self.recent.extend(returns.tolist())
        device = self.algorithm.agent.device
        batch = collected if device.type == "cpu" else collected.to(device)
        step = self.trained.steps + batch.numel()
        self.finite.observations(batch, step)
        learned = {} if self.reward_trainer is None else self.reward_trainer.update(batch)
        self.finite.losses(learned, step)  # Before its reward is used.
        try:
            batch = self.transform(batch)
        except NonFiniteReward as error:
            raise self.finite.error(error.what, step, "data") from error
        losses = self.algorithm.update(batch)
        before, self.trained.steps = self.trained.steps, step
        metrics = {f"{self.phase}/{name}": value for name, value in losses.items()}
        metrics.update(learned)
        metrics[f"{self.phase}/update_seconds"] = time.perf_counter() - started
        metrics[f"{self.phase}/reward_mean"] = batch.get(("next", "reward")).mean().item()
        metrics["train/episodes"] = float(len(returns))
        if len(returns):
            metrics["train/return_mean"] = returns.mean().item()
            metrics["train/length_mean"] = lengths.double().mean().item()
            self.shown_return = f"{metrics['train/return_mean']:,.1f}"
        episodes = dict.fromkeys(("train/return_mean", "train/length_mean"), float(len(returns)))
        self.means.add(metrics, weights=episodes)
        every = self.algorithm.log_every
        if step // every > before // every or self.is_over:
            self.run.log(step, self.means.take(), phase=self.phase)
        self.finite.losses(losses, step, batch.select(("next", "reward")))

    def save(self, env: BatchedEnv) -> None:
        """Writes the checkpoint, unless a weight is not finite."""
        for part in (self.algorithm.agent, self.transform):  # Not the tracker: any true reward is.
            self.finite.weights(part, self.trained.steps)
        trainer = self.reward_trainer
        state = {
            "steps": self.trained.steps,
            "seconds": self.trained.seconds,
            "inexact_resumes": self.trained.inexact_resumes,
            "stopped": self.trained.stopped,
            "recent": list(self.recent),
            "tracker": dict(self.tracker.state_dict()),
            "means": self.means.state_dict(),
            "transform": dict(self.transform.state_dict()),
            "algorithm": self.algorithm.state_dict(),
            "reward_trainer": None if trainer is None else trainer.state_dict(),
            "simulator": env.simulator_state(),
            "rng": rng_state(self.algorithm.agent.device),
        }
        self.run.save(self.phase, state)

    def begin(self) -> dict[str, Any] | None:
        """The checkpoint, if there is one, and its counters."""
        saved = self.run.load(self.phase)
        if saved is not None:
            with refusing_misfits(self.run, self.phase):
                for name in ("steps", "seconds", "inexact_resumes", "stopped"):
                    setattr(self.trained, name, saved[name])
                self.recent.extend(saved["recent"])
        return saved

    def restore(self, saved: dict[str, Any]) -> None:
        """Puts a checkpoint's tensors back."""
        with refusing_misfits(self.run, self.phase):
            self.tracker.load_state_dict(saved["tracker"])
            self.means.load_state_dict(saved["means"])
            self.transform.load_state_dict(saved["transform"])
            self.algorithm.load_state_dict(saved["algorithm"])
            if self.reward_trainer is not None:
                self.reward_trainer.load_state_dict(saved["reward_trainer"])

    def restore_simulators(self, env: BatchedEnv, saved: dict[str, Any]) -> bool:
        """Puts the simulators back; whether they came to where they were saved."""
        with refusing_misfits(self.run, self.phase):
            exact = env.restore_simulator(saved["simulator"])
        self.trained.inexact_resumes += not exact
        return exact

    def forget_episodes(self) -> None:
        """Warns that running episodes are lost, and clears the sums over them."""
        warnings.warn(
            "the simulator did not come back to where it was saved (it does not repeat itself, or "
            f"is another version): this run continues at {self.trained.steps:,} steps with fresh "
            "episodes, which result.json counts in inexact_resumes.",
            stacklevel=3,
        )
        forget_episodes(self.tracker, self.transform)


def forget_episodes(tracker: EpisodeTracker, transform: nn.Module) -> None:
    """Clears the sums over running episodes, whose rest is lost."""
    tracker.running_return.zero_()
    tracker.running_length.zero_()
    for part in transform.modules():
        if isinstance(part, ReturnScaling) and part.reset_rule == "done":
            part.running_return.zero_()


def _collector(env: BatchedEnv, algorithm: Algorithm, total_frames: int) -> Collector:
    return Collector(
        env,
        algorithm.act(),
        frames_per_batch=algorithm.frames_per_batch,
        total_frames=total_frames,
        track_traj_ids=False,
        trust_policy=True,
        auto_register_policy_transforms=False,
        # Each batch is made anew, so that it need not be copied before it is handed out.
        use_buffers=False,
        return_same_td=True,
    )


def _close(env: BatchedEnv) -> None:
    if not env.is_closed:  # By the collector.
        env.close()


def _on_one_thread(batches: Iterable[TensorDictBase]) -> Iterator[TensorDictBase]:
    """Collects with one torch thread: emulators have threads of their own and need the cores.

    Collecting takes 0.9 of the time so (two cores, 8 games).
    """
    iterator, threads = iter(batches), torch.get_num_threads()
    while True:
        torch.set_num_threads(1)
        try:
            batch = next(iterator)
        except StopIteration:
            return
        finally:
            torch.set_num_threads(threads)
        yield batch
