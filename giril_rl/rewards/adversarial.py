"""The maths of adversarial imitation, on the discriminator's logit: labels, rewards, penalty.

Labels, everywhere in this package: ``D(s, a) = sigmoid(logit)`` is the probability that the pair is
the **expert's** (label 1), and ``1 - D`` that it is the policy's (label 0). Ho and Ermon (2016)
label the other way round; ``docs/methods/gail.md`` translates.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, get_args

import torch
import torch.nn.functional as F
from torch import Tensor

from giril_rl.errors import UserError

RewardForm = Literal["positive", "negative", "log_ratio", "reversed"]


def discriminator_loss(expert: Tensor, policy: Tensor) -> tuple[Tensor, Tensor]:
    """Binary cross-entropy: the means of ``-log D`` (expert) and of ``-log(1 - D)`` (policy).

    Add them. Each set has its own mean, so that both weigh the same whatever their sizes.

    Args:
        expert: logits of the expert's pairs, any shape.
        policy: logits of the policy's pairs, any shape.

    Returns:
        The expert's and the policy's term, scalars.

    Examples:
        >>> ln3 = torch.tensor(3.0).log()  # D = 0.75
        >>> terms = discriminator_loss(ln3.reshape(1), torch.stack((ln3, -ln3)))
        >>> [round(term.exp().item(), 4) for term in terms]  # 4/3, and the root of 4 * 4/3
        [1.3333, 2.3094]
    """
    return F.softplus(-expert).mean(), F.softplus(policy).mean()


def adversarial_reward(logit: Tensor, form: RewardForm) -> Tensor:
    """The policy's reward for a pair, of the logit's shape.

    ===============  ====================  =========  ========================================
    form             with D = P(expert)    range      what it pays for besides likeness
    ===============  ====================  =========  ========================================
    ``"positive"``   ``-log(1 - D)``       (0, inf)   rewards survival: each step adds
    ``"negative"``   ``log D``             (-inf, 0)  punishes survival: each step costs
    ``"log_ratio"``  ``log D - log(1-D)``  all        neither by itself (the logit, as AIRL's)
    ``"reversed"``   ``-log D``            (0, inf)   rewards survival, and being *unlike*
    ===============  ====================  =========  ========================================

    Computed by softplus, so that no logit is too large.

    Args:
        logit: the discriminator's output.
        form: one of the four.

    Raises:
        UserError: for an unknown form.

    Examples:
        >>> logit = torch.tensor([3.0]).log()  # D = 0.75
        >>> [round(adversarial_reward(logit, form).exp().item(), 4)
        ...  for form in ("positive", "negative", "log_ratio", "reversed")]
        [4.0, 0.75, 3.0, 1.3333]
    """
    if form == "positive":
        return F.softplus(logit)
    if form == "negative":
        return -F.softplus(-logit)
    if form == "log_ratio":
        return logit
    if form == "reversed":
        return F.softplus(-logit)
    raise UserError(f"form={form!r} is unknown: choose one of {', '.join(get_args(RewardForm))}.")


def with_absorbing(mean: Tensor, absorbing: Tensor, rate: Tensor) -> Tensor:
    """A set's mean with its absorbing pairs: ``(mean + rate * absorbing) / (1 + rate)``.

    All absorbing pairs are the same one, so a set's mean over ordinary and absorbing pairs needs
    its value once (Kostrikov et al. 2019, arXiv 1809.02925, section 4.1).

    Args:
        mean: mean over the ordinary pairs.
        absorbing: the absorbing pair's value.
        rate: absorbing pairs for each ordinary one; one enters with each failure.

    Examples:
        >>> ordinary = torch.tensor([1.0, 2.0, 3.0, 6.0])  # Two of four end in a failure, worth 9.
        >>> with_absorbing(ordinary.mean(), torch.tensor(9.0), torch.tensor(0.5))
        tensor(5.)
    """
    return (mean + rate * absorbing) / (1 + rate)


def interpolated(expert: Tensor, policy: Tensor, weight: Tensor) -> Tensor:
    """Points between pairs of the two sets: ``weight * expert + (1 - weight) * policy``.

    The smaller set is repeated until it is as long as the larger.

    Args:
        expert: ``(n, *features)``.
        policy: ``(m, *features)``.
        weight: ``(max(n, m),)``, in [0, 1].

    Examples:
        >>> expert, policy = torch.tensor([[1.0], [2.0], [3.0]]), torch.tensor([[0.0], [10.0]])
        >>> interpolated(expert, policy, torch.tensor([1.0, 0.5, 0.5])).flatten()
        tensor([1.0000, 6.0000, 1.5000])
    """
    index = torch.arange(len(weight), device=weight.device)
    weight = weight.reshape(-1, *[1] * (expert.ndim - 1))
    return weight * expert[index % len(expert)] + (1 - weight) * policy[index % len(policy)]


def gradient_penalty(score: Callable[..., Tensor], points: Sequence[Tensor]) -> Tensor:
    """Mean of ``(‖gradient of score‖ - 1)^2`` (Gulrajani et al. 2017, arXiv 1704.00028, eq. 3).

    The norm is over the gradients with respect to all tensors in ``points`` together.

    Args:
        score: called with ``points``; one number per pair, whose shape is that of the batch.
        points: tensors ``(*batch, *features)``, such as observations and encoded actions.

    Returns:
        A scalar, differentiable with respect to the parameters of ``score``.

    Examples:
        >>> gradient_penalty(lambda s, a: 3 * s[:, 0] + 4 * a[:, 0], torch.zeros(2, 5, 1))
        tensor(16.)
    """
    with torch.enable_grad():
        leaves = [point.detach().requires_grad_() for point in points]
        scores = score(*leaves)
        gradients = torch.autograd.grad(scores.sum(), leaves, create_graph=True)
        slopes = torch.cat([g.reshape(*scores.shape, -1) for g in gradients], -1)
        norm = torch.linalg.vector_norm(slopes, dim=-1)
        return (norm - 1).square().mean()


def dual_step(beta: Tensor, kl: Tensor, limit: float, step: float) -> Tensor:
    """``max(0, beta + step * (kl - limit))`` (Peng et al. 2019, arXiv 1810.00821, section 4).

    Args:
        beta: the multiplier of the constraint ``kl <= limit``.
        kl: the constrained quantity, in nats.
        limit: the information constraint I_c, in nats.
        step: change of the multiplier for a violation of one nat.

    Examples:
        >>> dual_step(torch.tensor(0.25), torch.tensor([2.5, 0.0]), limit=0.5, step=1.0)
        tensor([2.2500, 0.0000])
    """
    return (beta + step * (kl - limit)).clamp_min(0.0)
