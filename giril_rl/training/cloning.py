"""Behaviour cloning (BC): a policy fitted to a demonstration's actions, without an environment."""

from __future__ import annotations

import warnings
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.objectives import BCLoss

from giril_rl.config.schema import BCConfig
from giril_rl.errors import UserError
from giril_rl.moved import renamed_argument
from giril_rl.networks.normalise import RunningNormaliser
from giril_rl.policies import NORMALISED, PPOAgent
from giril_rl.rewards.method import ORANGE, Method, register
from giril_rl.rewards.transitions import PIXELS_AT_ONCE, read
from giril_rl.runs.randomness import stream_seed
from giril_rl.runs.run import Run
from giril_rl.training.fitting import run_fit
from giril_rl.training.loop import Trained

CHECKPOINT_EVERY = 1_000
"""Gradient steps between checkpoints."""

register(Method("bc", "BC", ORANGE, settings=BCConfig, rank=4))


@renamed_argument("held_out", "validation")
def clone_behaviour(
    agent: PPOAgent,
    data: TensorDictBase,
    cfg: BCConfig,
    *,
    seed: int,
    run: Run,
    validation: TensorDictBase | None = None,
    phase: str = "bc",
) -> Trained:
    """Fits ``agent``'s actor to demonstrated actions with AdamW; resumes by itself.

    Squared error of the mean action (Box) or cross-entropy (Discrete), both by TorchRL's
    ``BCLoss``. Observations are normalised by the training pairs' own statistics, which stay as
    they are. The step size decreases linearly to zero. With ``cfg.stop="held_out"`` the weights
    with the least loss on ``validation`` are kept; it is measured every ``cfg.log_every`` steps.
    With "fixed" the last weights are kept, and ``validation`` is only logged.

    Box actions are fitted in the policy's own units, in which the bounds are -1 and 1.

    The loss of a Box action says nothing of the sampling policy's standard deviation. At the end it
    is set to its maximum likelihood estimate, the root mean squared error of the mean action: on
    the validation pairs, or on the training pairs with "fixed"; at least ``cfg.min_std``.

    Args:
        agent: the policy; actor, normaliser and standard deviation are changed in place.
        data: training pairs, batch ``(n,)``, with ``"observation"`` (raw) and ``"action"`` as
            executed: Box actions in the environment's units and within the bounds, Discrete ones as
            integers or one-hot vectors.
        cfg: settings.
        seed: seeds the minibatches, where there are any.
        run: where metrics and checkpoints go.
        validation: other pairs of the same kind.
        phase: name of the checkpoint and of the metrics.

    Returns:
        No environment steps, and the seconds, those of earlier processes included.

    Raises:
        UserError: if ``cfg.stop="held_out"`` has no pairs to validate on, or actions are not the
            policy's.
        Interrupted: after a checkpoint, if the user asked for it with Ctrl-C.
        RunError: if a loss is no longer finite; the last checkpoint stays.
    """
    early = cfg.stop == "held_out"
    if early and (validation is None or not len(validation)):
        raise UserError(
            "bc.stop=held_out has no held-out transitions to look at: set demo.subsample to at "
            "least 2, or bc.stop=fixed."
        )
    observation, _ = read(data, ["observation", "action"])
    if isinstance(agent.normaliser, RunningNormaliser):
        agent.normaliser.fit(observation, least=cfg.min_scale)
    cloning = _Cloning(agent, data, cfg, seed, validation, phase)
    seconds = run_fit(
        cloning,
        steps=cfg.steps,
        log_every=cfg.log_every,
        checkpoint_every=CHECKPOINT_EVERY,
        run=run,
        phase=phase,
        name="behaviour cloning",
    )
    if early:
        agent.actor.load_state_dict(cloning.best["actor"])
    set_std(agent, cloning.sets["held_out" if early else "fitted"], cfg.min_std)
    return Trained(seconds=seconds)


class _Cloning:
    """A policy's loss on minibatches of a demonstration, and its best weights so far."""

    def __init__(
        self,
        agent: PPOAgent,
        data: TensorDictBase,
        cfg: BCConfig,
        seed: int,
        validation: TensorDictBase | None,
        phase: str,
    ) -> None:
        self.agent, self.cfg, self.phase = agent, cfg, phase
        self.sets = {"fitted": _pairs(agent, data)}
        if validation is not None and len(validation):
            self.sets["held_out"] = _pairs(agent, validation)
        self.loss = _loss(agent)
        self.optimizer = torch.optim.AdamW(
            agent.actor.parameters(), lr=cfg.lr, weight_decay=cfg.weight_decay, fused=True
        )
        self.generator = torch.Generator().manual_seed(stream_seed("training", seed))
        self.best: dict[str, Any] = {"step": 0, "loss": float("inf"), "actor": {}}

    @property
    def data(self) -> TensorDictBase:
        return self.sets["fitted"]

    def step(self, number: int) -> None:
        self.optimizer.param_groups[0]["lr"] = self.cfg.lr * (1 - number / self.cfg.steps)
        self.optimizer.zero_grad()
        self.loss(_minibatch(self.data, self.cfg.batch, self.generator))["loss_bc"].backward()
        self.optimizer.step()

    @torch.no_grad()
    def losses(self, steps: int) -> dict[str, float]:
        losses = {name: _mean_loss(self.loss, pairs) for name, pairs in self.sets.items()}
        if self.cfg.stop == "held_out" and losses["held_out"] < self.best["loss"]:
            weights = {k: v.clone() for k, v in self.agent.actor.state_dict().items()}
            self.best = {"step": steps, "loss": losses["held_out"], "actor": weights}
        return {f"{self.phase}/{name}/loss": value for name, value in losses.items()}

    def state_dict(self) -> dict[str, Any]:
        return {
            "best": self.best,
            "actor": dict(self.agent.actor.state_dict()),
            "optimizer": self.optimizer.state_dict(),
            "minibatches": self.generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.best = state["best"]
        self.agent.actor.load_state_dict(state["actor"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.generator.set_state(state["minibatches"])


@torch.no_grad()
def set_std(agent: PPOAgent, pairs: TensorDictBase, least: float) -> None:
    """Sets the standard deviation of Box actions to its maximum likelihood, per dimension.

    Args:
        agent: the policy; one for Discrete actions is left as it is.
        pairs: ``"normalised"`` observations and ``"action"``, in the policy's own units.
        least: smallest standard deviation, in the same units: of half a bounded action's range.

    Examples:
        >>> from torchrl.data import Bounded
        >>> from giril_rl.policies import ActorCritic
        >>> agent = ActorCritic(1, Bounded(-1, 1, shape=(1,)), hidden=())
        >>> agent.actor[-1].weight.data.fill_(1.0)
        tensor([[1.]])
        >>> action = torch.tensor([[0.3], [-0.3]])
        >>> pairs = TensorDict({NORMALISED: torch.zeros(2, 1), "action": action}, [2])
        >>> set_std(agent, pairs, least=0.01)
        >>> agent.log_std.exp().data
        tensor([0.3000])
    """
    if agent.log_std is None:
        return
    error = agent.actor(pairs.get(NORMALISED)) - pairs.get("action")
    agent.log_std.copy_(error.square().mean(0).sqrt().clamp(min=least).log())


def _loss(agent: PPOAgent) -> BCLoss:
    """TorchRL's loss on what the network puts out: the mean action, or the actions' logits."""
    actor = TensorDictModule(agent.actor, in_keys=[NORMALISED], out_keys=["action"])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # TorchRL's, about names that its own class does not list.
        return BCLoss(actor, loss_function="cross_entropy" if agent.discrete else "mse")


def _pairs(agent: PPOAgent, data: TensorDictBase) -> TensorDict:
    """Normalised observations and what the actor's output is fitted to."""
    observation, action = (
        entry.to(agent.device) for entry in read(data, ["observation", "action"])
    )
    action = _whole(agent, action, data.ndim)
    if agent.bounds is not None:
        action = agent.bounds.inverse(action)
    return TensorDict({NORMALISED: agent.normaliser(observation), "action": action}, data.shape)


def _whole(agent: PPOAgent, action: Tensor, batch_dims: int) -> Tensor:
    """The demonstrated actions, discrete ones as integers, once they fit the policy's."""
    size, event = agent.action_size, tuple(action.shape[batch_dims:])
    needed = f"integers from 0 to {size - 1} of shape (n,), or one-hot vectors of shape (n, {size})"
    if not agent.discrete:
        fits, needed = event == (size,), f"vectors of shape (n, {size})"
    elif event == (size,):
        fits = bool(((action != 0).sum(-1) == 1).all())
        action = action.long().argmax(-1)
    else:
        fits = event == () and not action.is_floating_point()
        fits = fits and bool(((action >= 0) & (action < size)).all())
    if not fits:
        raise UserError(
            f"actions are {action.dtype} of shape {tuple(action.shape)}, and the policy's are "
            f"{needed}: give those, or a policy of these actions."
        )
    return action


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
