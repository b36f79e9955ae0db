"""Behaviour cloning: a policy fitted to a demonstration's actions, without an environment."""

from __future__ import annotations

import time
import warnings
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.objectives import BCLoss

from giril_rl.config.schema import BCConfig
from giril_rl.errors import UserError
from giril_rl.networks.normalise import RunningNormaliser
from giril_rl.policies.agents import Agent
from giril_rl.policies.policy import NORMALISED
from giril_rl.rewards.transitions import PIXELS_AT_ONCE
from giril_rl.runs.finite import Finite
from giril_rl.runs.interrupt import Interrupt, Interrupted
from giril_rl.runs.progress import progress
from giril_rl.runs.randomness import stream_seed
from giril_rl.runs.restoring import restoring
from giril_rl.training.ppo import Trained

if TYPE_CHECKING:
    from giril_rl.runs.run import Run

CHECKPOINT_EVERY = 1_000


def clone_behaviour(
    agent: Agent,
    fitted: TensorDictBase,
    cfg: BCConfig,
    *,
    seed: int,
    run: Run,
    held_out: TensorDictBase | None = None,
    phase: str = "bc",
) -> Trained:
    """Fits ``agent``'s actor to the actions of ``fitted`` with AdamW; resumes by itself.

    Squared error of the mean action (Box) or cross-entropy (Discrete), both by TorchRL's
    ``BCLoss``. Observations are normalised by the fitted pairs' own statistics, which stay as they
    are. The step size decreases linearly to zero. With ``cfg.stop="held_out"`` the weights that are
    left are those with the least loss on ``held_out``, which is looked at every ``cfg.log_every``
    steps and never fitted; with "fixed" they are those of the last step, and ``held_out`` is only
    logged.

    Box actions are fitted in the policy's own units, in which the bounds are -1 and 1.

    The loss of a Box action says nothing of the sampling policy's deviation. It is set at the end
    to the root mean squared error of the mean action, which is its maximum of likelihood, on the
    held-out pairs, or on the fitted ones with "fixed"; at least ``cfg.min_std``.

    Args:
        agent: the policy; its actor, normaliser and deviation are changed in place.
        fitted: pairs to fit, batch ``(n,)``, with ``"observation"`` (raw) and ``"action"`` as
            executed: Box actions in the environment's units and within the bounds, Discrete ones as
            integers or one-hot vectors.
        cfg: settings.
        seed: seeds the minibatches, where there are any.
        run: where metrics and checkpoints go.
        held_out: other pairs of the same kind.
        phase: name of the checkpoint and of the metrics.

    Returns:
        No environment steps, and the seconds, those of earlier processes included.

    Raises:
        UserError: if ``cfg.stop="held_out"`` has no pairs to look at.
        Interrupted: after a checkpoint, if the user asked for it with Ctrl-C.
        RunError: if a loss is no longer finite; the last checkpoint stays.
    """
    if cfg.stop == "held_out" and (held_out is None or not len(held_out)):
        raise UserError(
            "bc.stop=held_out has no held-out transitions to look at: set demo.subsample to at "
            "least 2, or bc.stop=fixed."
        )
    if isinstance(agent.normaliser, RunningNormaliser):
        agent.normaliser.fit(fitted.get("observation"), least=cfg.min_scale)
    sets = {"fitted": _pairs(agent, fitted)}
    if held_out is not None and len(held_out):
        sets["held_out"] = _pairs(agent, held_out)
    loss = _loss(agent)
    optimizer = torch.optim.AdamW(
        agent.actor.parameters(), lr=cfg.lr, weight_decay=cfg.weight_decay, fused=True
    )
    generator = torch.Generator().manual_seed(stream_seed("training", seed))
    step, seconds = 0, 0.0
    best: dict[str, Any] = {"step": 0, "loss": float("inf"), "actor": {}}
    saved = run.load(phase)
    if saved is not None:
        with restoring(run, phase):
            step, seconds, best = saved["step"], saved["seconds"], saved["best"]
            agent.actor.load_state_dict(saved["actor"])
            optimizer.load_state_dict(saved["optimizer"])
            generator.set_state(saved["minibatches"])
    run.truncate_metrics(phase, step)
    began = time.perf_counter() - seconds
    finite = Finite(run.folder, cfg.steps, "gradient steps")

    with Interrupt() as interrupt, progress(cfg.steps, step, "cloning") as bar:
        while step < cfg.steps:
            block = min(cfg.log_every - step % cfg.log_every, cfg.steps - step)
            for done in range(step, step + block):
                optimizer.param_groups[0]["lr"] = cfg.lr * (1 - done / cfg.steps)
                optimizer.zero_grad()
                loss(_minibatch(sets["fitted"], cfg.batch, generator))["loss_bc"].backward()
                optimizer.step()
            step += block
            with torch.no_grad():
                losses = {name: _mean_loss(loss, pairs) for name, pairs in sets.items()}
            if cfg.stop == "held_out" and losses["held_out"] < best["loss"]:
                weights = {k: v.clone() for k, v in agent.actor.state_dict().items()}
                best = {"step": step, "loss": losses["held_out"], "actor": weights}
            bar.update(block, loss=f"{losses['fitted']:.3g}")
            metrics = {f"{phase}/{name}/loss": value for name, value in losses.items()}
            run.log(step, metrics, phase=phase)
            finite.losses(metrics, step, sets["fitted"])
            asked = interrupt.requested
            if step % CHECKPOINT_EVERY < block or step == cfg.steps or asked:
                seconds = time.perf_counter() - began
                state = {
                    "step": step,
                    "seconds": seconds,
                    "best": best,
                    "actor": dict(agent.actor.state_dict()),
                    "optimizer": optimizer.state_dict(),
                    "minibatches": generator.get_state(),
                }
                run.save(phase, state)
            if asked:
                break
    if interrupt.requested:  # At the end as well, for the run may have more to do.
        raise Interrupted.at(step, cfg.steps, "gradient steps", part="behaviour cloning")
    if cfg.stop == "held_out":
        agent.actor.load_state_dict(best["actor"])
    set_deviation(agent, sets["held_out" if cfg.stop == "held_out" else "fitted"], cfg.min_std)
    return Trained(0, seconds)


@torch.no_grad()
def set_deviation(agent: Agent, pairs: TensorDictBase, least: float) -> None:
    """Gives Box actions the deviation that makes ``pairs`` likeliest, one for each dimension.

    Args:
        agent: the policy; one for Discrete actions is left as it is.
        pairs: ``"normalised"`` observations and ``"action"``, in the policy's own units.
        least: smallest deviation, in the same units: of half the range of a bounded action.

    Examples:
        >>> from torchrl.data import Bounded
        >>> from giril_rl.policies.policy import ActorCritic
        >>> agent = ActorCritic(1, Bounded(-1, 1, shape=(1,)), hidden=())
        >>> agent.actor[-1].weight.data.fill_(1.0)
        tensor([[1.]])
        >>> action = torch.tensor([[0.3], [-0.3]])
        >>> pairs = TensorDict({NORMALISED: torch.zeros(2, 1), "action": action}, [2])
        >>> set_deviation(agent, pairs, least=0.01)
        >>> agent.log_std.exp().data
        tensor([0.3000])
    """
    if agent.log_std is None:
        return
    error = agent.actor(pairs.get(NORMALISED)) - pairs.get("action")
    agent.log_std.copy_(error.square().mean(0).sqrt().clamp(min=least).log())


def _loss(agent: Agent) -> BCLoss:
    """TorchRL's loss on what the network puts out: the mean action, or the actions' logits."""
    actor = TensorDictModule(agent.actor, in_keys=[NORMALISED], out_keys=["action"])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # TorchRL's, about names that its own class does not list.
        return BCLoss(actor, loss_function="cross_entropy" if agent.discrete else "mse")


def _pairs(agent: Agent, data: TensorDictBase) -> TensorDict:
    """Normalised observations and what the actor's output is fitted to."""
    data = data.to(agent.device)
    normalised = agent.normaliser(data.get("observation"))
    action = data.get("action")
    if agent.bounds is not None:
        action = agent.bounds.inverse(action)
    elif agent.discrete and action.ndim > data.ndim:
        action = action.long().argmax(-1)
    return TensorDict({NORMALISED: normalised, "action": action}, data.shape)


def _mean_loss(loss: BCLoss, pairs: TensorDict) -> float:
    if pairs.get(NORMALISED).ndim == 2:
        return loss(pairs)["loss_bc"].item()
    # Frames would take gigabytes at once.
    parts = [(len(part), loss(part)["loss_bc"].item()) for part in pairs.split(PIXELS_AT_ONCE)]
    return sum(size * value for size, value in parts) / len(pairs)


def _minibatch(pairs: TensorDict, size: int, generator: torch.Generator) -> TensorDict:
    if len(pairs) <= size:
        return pairs
    index: Tensor = torch.randint(len(pairs), (size,), generator=generator)
    return pairs[index.to(pairs.get("action").device)]
