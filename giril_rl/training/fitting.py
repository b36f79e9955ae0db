"""Fitting to a fixed data set: gradient steps that log, checkpoint, resume and stop."""

from __future__ import annotations

import time
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from torchrl.objectives import LossModule

from giril_rl.config.schema import FitConfig
from giril_rl.graphs.gradients import TracedGradients
from giril_rl.moved import renamed_argument
from giril_rl.rewards.fitting import TransitionLoss, check_pairs
from giril_rl.rewards.transitions import PIXELS_AT_ONCE
from giril_rl.runs.checkpoint import refusing_misfits
from giril_rl.runs.finite_checks import Finite
from giril_rl.runs.interrupt import Interrupt, Interrupted
from giril_rl.runs.progress import progress
from giril_rl.runs.randomness import restore_rng, rng_state, seeded, stream_seed
from giril_rl.runs.run import Run

CHECKPOINT_EVERY = 5_000
"""Gradient steps of a reward model between checkpoints."""


class Fit(Protocol):
    """What :func:`run_fit` drives: a model, its optimizer and its data."""

    @property
    def data(self) -> TensorDictBase:
        """The training set, where a loss that is not finite may have its cause."""
        ...

    def step(self, number: int) -> None:
        """One gradient step, the ``number``-th from 0."""
        ...

    def losses(self, steps: int) -> dict[str, float]:
        """Losses on whole sets after ``steps`` steps, the training loss first."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """All that later steps depend on, of the kinds that a checkpoint can hold."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` gave."""
        ...


def run_fit(
    fit: Fit,
    *,
    steps: int,
    log_every: int,
    checkpoint_every: int,
    run: Run,
    phase: str,
    name: str,
    unit: str = "gradient steps",
) -> float:
    """Takes all gradient steps of a fit; resumes by itself.

    Args:
        fit: what is fitted.
        steps: gradient steps in all.
        log_every: gradient steps between logged losses.
        checkpoint_every: gradient steps between checkpoints.
        run: where metrics and checkpoints go.
        phase: name of the checkpoint and of the metrics.
        name: what is done, for the progress bar and a sentence.
        unit: what a step is called.

    Returns:
        Seconds, those of earlier processes included.

    Raises:
        Interrupted: after a checkpoint, if the user asked for it with Ctrl-C.
        RunError: if a loss is no longer finite; the last checkpoint stays.
    """
    step, seconds = 0, 0.0
    saved = run.load(phase)
    if saved is not None:
        with refusing_misfits(run, phase):
            step, seconds = saved["step"], saved["seconds"]
            fit.load_state_dict(saved["fit"])
    run.truncate_metrics(phase, step)
    began = time.perf_counter() - seconds
    finite = Finite(run.folder, steps, unit)
    with Interrupt() as interrupt, progress(steps, step, name) as bar:
        while step < steps and not interrupt.requested:
            block = min(log_every - step % log_every, steps - step)
            for number in range(step, step + block):
                fit.step(number)
            step += block
            losses = fit.losses(step)
            bar.update(block, loss=f"{next(iter(losses.values())):.3g}")
            run.log(step, losses, phase=phase)
            finite.losses(losses, step, fit.data)
            if step % checkpoint_every < block or step == steps or interrupt.requested:
                seconds = time.perf_counter() - began
                run.save(phase, {"step": step, "seconds": seconds, "fit": fit.state_dict()})
    if interrupt.requested:  # At the end as well, for the run may have more to do.
        raise Interrupted.at(step, steps, unit, part=name)
    return seconds


@renamed_argument("held_out", "validation")
def fit_reward(
    loss: LossModule,
    data: TensorDictBase,
    cfg: FitConfig,
    *,
    seed: int,
    run: Run,
    validation: TensorDictBase | None = None,
    phase: str = "fit",
) -> float:
    """Minimises a reward model's loss on a demonstration, before the policy's training.

    The paper's Algorithm 1, with Adam on random minibatches; resumes by itself.

    Args:
        loss: the reward model's loss; its modules are trained in place.
        data: the training set, batch ``(n,)``, with the loss's ``in_keys``.
        cfg: steps, batch size and step size.
        seed: seeds minibatches and the loss's own noise.
        run: where metrics and checkpoints go.
        validation: transitions that losses are logged on and nothing is fitted to.
        phase: name of the checkpoint and of the metrics.

    Returns:
        Seconds of fitting, those of earlier processes included; ``run.fit_seconds`` counts them.

    Raises:
        UserError: for transitions that do not fit the reward.
        Interrupted: after a checkpoint, if the user asked for it with Ctrl-C.
        RunError: if a loss is no longer finite; the last checkpoint stays.
    """
    # Some losses read more than transitions, such as which member of an ensemble sees them.
    if isinstance(loss, TransitionLoss) and loss.in_keys == loss.reward.in_keys:
        check_pairs(loss, data)
    fit = _RewardFit(loss, data, cfg, seed, validation)
    seconds = run_fit(
        fit,
        steps=cfg.steps,
        log_every=cfg.log_every,
        checkpoint_every=CHECKPOINT_EVERY,
        run=run,
        phase=phase,
        name="the reward model's fit",
        unit="fitting steps",
    )
    loss.eval()
    run.fit_seconds += seconds
    return seconds


class _RewardFit:
    """A reward model's loss on minibatches of a demonstration."""

    def __init__(
        self,
        loss: LossModule,
        data: TensorDictBase,
        cfg: FitConfig,
        seed: int,
        validation: TensorDictBase | None,
    ) -> None:
        self.loss, self.cfg = loss, cfg
        self.gradients = TracedGradients(loss, keys=loss.in_keys, compile=cfg.compile)
        self.optimizer = torch.optim.Adam(self.gradients.parameters, lr=cfg.lr, fused=True)
        self.device = self.gradients.parameters[0].device
        self.sets = {"fitted": data.to(self.device)}
        if validation is not None and len(validation):
            self.sets["held_out"] = validation.to(self.device)
        self.columns = [self.sets["fitted"].get(key).contiguous() for key in loss.in_keys]
        self.generator = torch.Generator().manual_seed(stream_seed("reward", seed))
        self.indices: list[torch.Tensor] = []
        torch.manual_seed(stream_seed("reward", seed))

    @property
    def data(self) -> TensorDictBase:
        return self.sets["fitted"].select(*self.loss.in_keys)

    def step(self, number: int) -> None:
        if not self.indices:
            self._draw(number)
        index = self.indices.pop()
        self.gradients.step([column[index] for column in self.columns])
        self.optimizer.step()

    def _draw(self, number: int) -> None:
        """The minibatches up to the next logged step, drawn at once."""
        cfg = self.cfg
        block = min(cfg.log_every - number % cfg.log_every, cfg.steps - number)
        rows = len(self.columns[0])
        indices = torch.randint(rows, (block, cfg.batch), generator=self.generator)
        self.indices = list(indices.to(self.device))[::-1]
        self.loss.train()

    def losses(self, steps: int) -> dict[str, float]:
        """The loss's terms on each set, with noise that leaves the run's random numbers alone.

        Of frames and of snippets only the first, for they would take seconds and gigabytes.
        """
        values: dict[str, float] = {}
        self.loss.eval()
        for name, data in self.sets.items():
            with torch.no_grad(), seeded(0, self.device):
                observation = data.get("observation", None)
                large = observation is None or observation.ndim > 2
                for key, value in self.loss(data[:PIXELS_AT_ONCE] if large else data).items():
                    term = str(key).removeprefix("loss_")
                    values[f"fit/{name}/{term}"] = value.item()
        return values

    def state_dict(self) -> dict[str, Any]:
        return {
            "loss": dict(self.loss.state_dict()),
            "optimizer": self.optimizer.state_dict(),
            "minibatches": self.generator.get_state(),
            "rng": rng_state(self.device),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.loss.load_state_dict(state["loss"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.generator.set_state(state["minibatches"])
        restore_rng(state["rng"])
