"""Fitting a reward to a demonstration, in one call."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase

from giril_rl.errors import UserError
from giril_rl.rewards.transition_loss import TransitionLoss
from giril_rl.rewards.transitions import check_finite, check_transitions, read
from giril_rl.runs.randomness import seeded


def fit(
    loss: TransitionLoss,
    demonstration: TensorDictBase,
    *,
    steps: int = 50_000,
    batch: int = 32,
    lr: float = 3e-5,
    seed: int = 0,
) -> dict[str, float]:
    """Fits the reward's scaler, then minimises its loss by Adam; the defaults are the paper's.

    The recipes' training does the same with checkpoints and logs; this is for other projects.

    Args:
        loss: the reward's loss; its module is trained in place and left in eval mode.
        demonstration: transitions of any leading shape, with the loss's ``in_keys``; a copy goes to
            the loss's device.
        steps: gradient steps.
        batch: transitions in each, drawn with replacement.
        lr: Adam's step size.
        seed: seeds minibatches and the loss's noise. The global random state is left as it was.

    Returns:
        The loss's terms at the last step.

    Raises:
        UserError: for a loss that needs the policy's transitions as well, no transitions or steps,
            entries that are missing, NaN, infinite or of a wrong shape, actions outside the action
            spec, or a loss that is no longer finite at the end.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from giril_rl.rewards import GenerativeReward, GenerativeRewardLoss
        >>> s, a = torch.randn(50, 2), torch.rand(50, 1)
        >>> demo = TensorDict({"observation": s, "action": a, "next": {"observation": s + a}}, [50])
        >>> reward = GenerativeReward.for_vectors(2, Bounded(-1, 1, shape=(1,)))
        >>> sorted(fit(GenerativeRewardLoss(reward), demo, steps=3))
        ['loss_action', 'loss_kl', 'loss_reconstruction']
    """
    if not isinstance(loss, TransitionLoss):
        raise UserError(
            f"{type(loss).__name__} needs the policy's transitions as well: train it beside the "
            "policy, not before."
        )
    count = demonstration.batch_size.numel()
    if count < 1 or steps < 1 or batch < 1:
        raise UserError(
            f"{count} transitions, steps={steps} and batch={batch}: give at least one of each."
        )
    _check(loss, demonstration)
    device = next(loss.parameters()).device
    data = demonstration.select(*loss.in_keys).reshape(-1).to(device)
    loss.reward.scaler.fit(data.get(loss.in_keys[0]))
    optimizer = torch.optim.Adam(loss.parameters(), lr=lr)
    loss.train()
    with seeded(seed, device), torch.enable_grad():
        for _ in range(steps):
            terms = loss(data[torch.randint(len(data), (batch,))])
            optimizer.zero_grad()
            torch.stack([term.sum() for term in terms.values()]).sum().backward()
            optimizer.step()
    loss.eval()
    last = {str(key): term.mean().item() for key, term in terms.items()}
    for name, value in last.items():
        if not math.isfinite(value):
            raise UserError(f"{name} is {value} after {steps} steps of lr={lr}: give a smaller lr.")
    return last


def _check(loss: TransitionLoss, demonstration: TensorDictBase) -> None:
    """Looks at the whole demonstration once, so that a minibatch need not be looked at."""
    entries = observation, action, following = read(demonstration, loss.in_keys)
    scaler, actions = loss.reward.scaler, loss.reward.actions
    batch = observation.shape[: observation.ndim - scaler.event_dims]
    if batch != demonstration.batch_size:
        raise UserError(
            f"the demonstration's batch_size is {list(demonstration.batch_size)} where its "
            f"observations have {list(batch)}: give TensorDict(..., batch_size={list(batch)})."
        )
    check_transitions(scaler, actions, observation, action, following)
    for key, entry in zip(loss.in_keys, entries, strict=True):
        check_finite(str(key), entry)
    actions.check_values(action)
