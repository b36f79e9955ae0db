"""DRIL's mathematics: how much an ensemble disagrees, what that pays, and what its members learn.

Pure functions of Brantley, Sun and Henaff, ICLR 2020, "Disagreement-Regularized Imitation
Learning"; :mod:`giril_rl.rewards.dril` applies them.
"""

from __future__ import annotations

from typing import Literal, get_args

import torch
import torch.nn.functional as F
from tensordict import TensorDictBase
from torch import Tensor

from giril_rl.errors import UserError
from giril_rl.runs.randomness import stream_seed

Variance = Literal["action", "state"]
Form = Literal["sign", "penalty", "variance"]
BOOTSTRAP = "bootstrap"
"""How often each member's sample has a transition, ``(n, members)``; see :func:`bootstrapped`."""


def action_variance(members: Tensor, action: Tensor) -> Tensor:
    """Variance over the members of their output's inner product with an action.

    Of probabilities and a one-hot action it is the variance of the action's probability, the
    paper's equation for C_U. Of mean actions it is ``a^T Cov a``, as in the authors' code for
    continuous actions. Variances are the population's.

    Args:
        members: probabilities or mean actions, ``(members, *batch, k)``.
        action: encoded, ``(*batch, k)``.

    Returns:
        ``(*batch,)``.

    Examples:
        >>> members = torch.tensor([[[0.9, 0.1]], [[0.5, 0.5]]])
        >>> action_variance(members, torch.tensor([[0.0, 1.0]]))  # of 0.1 and 0.5
        tensor([0.0400])
    """
    return (members * action).sum(-1).var(0, correction=0)


def state_variance(members: Tensor) -> Tensor:
    """Variance over the members of their output, summed over its dimensions.

    Args:
        members: probabilities or mean actions, ``(members, *batch, k)``.

    Examples:
        >>> state_variance(torch.tensor([[[0.9, 0.1]], [[0.5, 0.5]]]))
        tensor([0.0800])
    """
    return members.var(0, correction=0).sum(-1)


def disagreement_reward(variance: Tensor, threshold: Tensor | float, form: Form) -> Tensor:
    """The clipped cost of Brantley et al. (2020), negated, or the variance itself.

    Args:
        variance: of any shape.
        threshold: q.
        form: ``"sign"`` is +1 for a variance of at most q and -1 above (the paper's);
            ``"penalty"`` 0 and -1; ``"variance"`` minus the variance.

    Raises:
        UserError: for an unknown form.

    Examples:
        >>> v = torch.tensor([0.1, 0.2, 0.3])
        >>> disagreement_reward(v, 0.2, "sign"), disagreement_reward(v, 0.2, "penalty")
        (tensor([ 1.,  1., -1.]), tensor([ 0.,  0., -1.]))
    """
    if form not in get_args(Form):
        raise UserError(f"form={form!r} is unknown: choose sign, penalty or variance.")
    if form == "variance":
        return -variance
    return torch.where(variance > threshold, -1.0, 1.0 if form == "sign" else 0.0)


def bootstrapped(pairs: TensorDictBase, members: int, *, seed: int | None) -> TensorDictBase:
    """``pairs`` with the :data:`BOOTSTRAP` counts of a sample with replacement for each member.

    Args:
        pairs: ``(n,)``; a shallow copy is returned.
        members: policies in the ensemble.
        seed: of the samples; the global random state stays as it is. None counts every transition
            once for each member, as is right for held-out ones.

    Examples:
        >>> from tensordict import TensorDict
        >>> pairs = bootstrapped(TensorDict({"action": torch.zeros(9, 1)}, [9]), 2, seed=0)
        >>> pairs["bootstrap"].sum(0)
        tensor([9., 9.])
    """
    n = len(pairs)
    if seed is None:
        return pairs.clone(False).set(BOOTSTRAP, torch.ones(n, members, device=pairs.device))
    generator = torch.Generator().manual_seed(stream_seed("reward", seed))
    drawn = torch.randint(max(n, 1), (members, n), generator=generator)
    counts = torch.zeros(members, n).scatter_add(1, drawn, torch.ones(members, n))
    return pairs.clone(False).set(BOOTSTRAP, counts.T.contiguous().to(pairs.device))


def cloning_losses(outputs: Tensor, target: Tensor, discrete: bool) -> Tensor:
    """Each member's loss of each transition, ``(members, *batch)``.

    Args:
        outputs: ``(members, *batch, k)``.
        target: class indices ``(*batch,)``, or encoded actions ``(*batch, k)``.
        discrete: whether it is indices.

    Examples:
        >>> outputs = torch.tensor([[[0.5, 0.0]], [[1.0, 1.0]]])
        >>> cloning_losses(outputs, torch.tensor([[1.0, 0.0]]), discrete=False)
        tensor([[0.1250],
                [0.5000]])
    """
    if not discrete:
        return (outputs - target).square().mean(-1)
    chosen = target.expand(outputs.shape[:-1]).unsqueeze(-1)
    return -F.log_softmax(outputs, -1).gather(-1, chosen).squeeze(-1)
