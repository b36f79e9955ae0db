"""Fitting a reward model to a demonstration, before the policy's training (Algorithm 1)."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.objectives import LossModule

from giril_rl.config.schema import FitConfig
from giril_rl.graphs.traced import TracedGradients
from giril_rl.rewards.transitions import PIXELS_AT_ONCE
from giril_rl.runs.finite import Finite
from giril_rl.runs.interrupt import Interrupt, Interrupted
from giril_rl.runs.progress import progress
from giril_rl.runs.randomness import restore_rng, rng_state, seeded, stream_seed
from giril_rl.runs.restoring import restoring

if TYPE_CHECKING:
    from giril_rl.runs.run import Run

CHECKPOINT_EVERY = 5_000


def fit_reward(
    loss: LossModule,
    data: TensorDictBase,
    cfg: FitConfig,
    *,
    seed: int,
    run: Run,
    held_out: TensorDictBase | None = None,
    phase: str = "fit",
) -> float:
    """Minimises ``loss`` on random minibatches of ``data`` with Adam; resumes by itself.

    Args:
        loss: the reward model's loss; its modules are trained in place.
        data: transitions to fit, batch ``(n,)``, with the loss's ``in_keys``.
        cfg: steps, batch size and step size.
        seed: seeds minibatches and the loss's own noise.
        run: where metrics and checkpoints go.
        held_out: transitions that the losses are logged on besides, never fitted.
        phase: name of the checkpoint and of the metrics.

    Returns:
        Seconds of fitting, those of earlier processes included; ``run.fit_seconds`` counts them.

    Raises:
        Interrupted: after a checkpoint, if the user asked for it with Ctrl-C.
        RunError: if a loss is no longer finite; the last checkpoint stays.
    """
    keys = loss.in_keys
    gradients = TracedGradients(loss, keys=keys, compile=cfg.compile)
    optimizer = torch.optim.Adam(gradients.parameters, lr=cfg.lr, fused=True)
    device = gradients.parameters[0].device
    data = data.to(device)
    held_out = None if held_out is None else held_out.to(device)
    columns = [data.get(key).contiguous() for key in keys]
    generator = torch.Generator().manual_seed(stream_seed("reward", seed))
    torch.manual_seed(stream_seed("reward", seed))
    step, seconds = 0, 0.0
    saved = run.load(phase)
    if saved is not None:
        with restoring(run, phase):
            step, seconds = saved["step"], saved["seconds"]
            loss.load_state_dict(saved["loss"])
            optimizer.load_state_dict(saved["optimizer"])
            generator.set_state(saved["minibatches"])
            restore_rng(saved["rng"])
    run.truncate_metrics(phase, step)
    began = time.perf_counter() - seconds
    finite = Finite(run.folder, cfg.steps, "fitting steps")
    with Interrupt() as interrupt, progress(cfg.steps, step, "reward model") as bar:
        while step < cfg.steps:
            block = min(cfg.log_every - step % cfg.log_every, cfg.steps - step)
            indices = torch.randint(len(data), (block, cfg.batch), generator=generator)
            indices = indices.to(device)
            loss.train()
            for index in indices:
                gradients.step([column[index] for column in columns])
                optimizer.step()
            step += block
            bar.update(block)
            losses = _evaluate(loss, {"fitted": data, "held_out": held_out})
            run.log(step, losses, phase=phase)
            finite.losses(losses, step, data.select(*keys))
            asked = interrupt.requested
            if step % CHECKPOINT_EVERY < block or step == cfg.steps or asked:
                state = {
                    "step": step,
                    "seconds": time.perf_counter() - began,
                    "loss": dict(loss.state_dict()),
                    "optimizer": optimizer.state_dict(),
                    "minibatches": generator.get_state(),
                    "rng": rng_state(device),
                }
                run.save(phase, state)
            if asked:
                break
    if interrupt.requested:  # At the end as well, for the run may have more to do.
        raise Interrupted.at(step, cfg.steps, "fitting steps", part="the reward model's fit")
    loss.eval()
    if saved is None or step > saved["step"]:
        seconds = time.perf_counter() - began
    run.fit_seconds += seconds
    return seconds


def _evaluate(loss: nn.Module, sets: dict[str, TensorDictBase | None]) -> dict[str, float]:
    """The loss's terms on whole sets, with noise that leaves the run's random numbers alone.

    Of frames only the first, for they would take seconds and gigabytes.
    """
    values: dict[str, float] = {}
    loss.eval()
    for name, data in sets.items():
        if data is None or not len(data):
            continue
        with torch.no_grad(), seeded(0, data.get("observation").device):
            frames = data.get("observation").ndim > 2
            for key, value in loss(data[:PIXELS_AT_ONCE] if frames else data).items():
                values[f"fit/{name}/{str(key).removeprefix('loss_')}"] = value.item()
    return values
