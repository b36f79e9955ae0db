"""Training GIRIL's reward model: the conditional VAE's objective on a demonstration."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from tensordict.utils import NestedKey
from torch import Tensor

from giril_rl.errors import UserError
from giril_rl.rewards.equations import reconstruction_error
from giril_rl.rewards.generative import GenerativeReward
from giril_rl.rewards.transition_loss import Reduction, TransitionLoss
from giril_rl.rewards.transitions import check_transitions


def gaussian_kl(
    mu_q: Tensor, logvar_q: Tensor, mu_p: Tensor | None = None, logvar_p: Tensor | None = None
) -> Tensor:
    """``KL(q || p)`` of diagonal Gaussians, summed over the last dimension (paper, eq. 1).

    Args:
        mu_q: mean of q, ``(*batch, latent)``.
        logvar_q: log-variance of q.
        mu_p: mean of p; None means 0.
        logvar_p: log-variance of p; None means 0.

    Examples:
        >>> gaussian_kl(torch.tensor([[2.0, 0.0]]), torch.zeros(1, 2))
        tensor([2.])
    """
    difference = mu_q if mu_p is None else mu_q - mu_p
    if logvar_p is None:
        terms = logvar_q.exp() + difference.square() - 1 - logvar_q
    else:
        log_ratio = logvar_q - logvar_p
        terms = log_ratio.exp() + difference.square() * (-logvar_p).exp() - 1 - log_ratio
    return 0.5 * terms.sum(-1)


def action_term(z: Tensor, action: Tensor) -> Tensor:
    """How far the encoded action is from the expert's (paper, eq. 1's third term).

    KL to a one-hot expert policy is infinite; what can be computed, and what the paper's appendix
    and released code use, is cross-entropy for discrete actions and MSE for continuous ones.

    Args:
        z: latent ``(*batch, latent)``.
        action: integer class indices ``(*batch,)``, for which z holds logits, or the continuous
            action's code ``(*batch, latent)``, from which z's squared distance is averaged.

    Returns:
        One number per transition, ``(*batch,)``.

    Examples:
        >>> action_term(torch.zeros(1, 4), torch.tensor([2])).exp()
        tensor([4.])
        >>> action_term(torch.tensor([[1.0, 0.0]]), torch.tensor([[0.0, 2.0]]))
        tensor([2.5000])
    """
    if action.is_floating_point():
        return (z - action).square().mean(-1)
    return -F.log_softmax(z, -1).gather(-1, action.unsqueeze(-1)).squeeze(-1)


class GenerativeRewardLoss(TransitionLoss):
    """The negative of eq. 1, in its three terms, whose sum is to be minimised.

    - ``loss_reconstruction``: lambda * squared norm of ``decoder(z, s) - s'``, with z itself, not
      softmax(z), as the paper has it in training; z is sampled by reparameterisation, with noise
      from the global generator.
    - ``loss_kl``: KL of ``q(z | s, s')`` to N(0, I), or to the reward's conditional prior.
    - ``loss_action``: alpha times :func:`action_term`.

    Each term is summed over features per transition and then reduced over the batch. Observations
    are scaled by the reward's scaler; the prediction is not clamped, for a clamped one would have
    no gradient.

    Args:
        reward: the module to train; its parameters are this loss's parameters.
        alpha: weight of the action term; None takes 1 for continuous actions and 100 for discrete
            ones.
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` over transitions.
        functional: see :class:`~giril_rl.rewards.TransitionLoss`.

    Raises:
        UserError: for an unknown reduction or a negative alpha.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> reward = GenerativeReward.for_vectors(2, Bounded(-1, 1, shape=(1,)), normalise="raw")
        >>> loss = GenerativeRewardLoss(reward)
        >>> s, a = torch.zeros(4, 2), torch.zeros(4, 1)
        >>> batch = TensorDict({"observation": s, "action": a, "next": {"observation": s}}, [4])
        >>> sorted(loss(batch).keys())
        ['loss_action', 'loss_kl', 'loss_reconstruction']
    """

    reward: GenerativeReward

    def __init__(
        self,
        reward: GenerativeReward,
        *,
        alpha: float | None = None,
        reduction: Reduction = "mean",
        functional: bool = False,
    ) -> None:
        super().__init__(reward, reduction=reduction, functional=functional)
        if alpha is None:
            alpha = 100.0 if reward.actions.discrete else 1.0
        if not alpha >= 0:
            raise UserError(f"alpha={alpha} is negative: give a weight of 0 or more.")
        self.alpha = alpha

    @property
    def out_keys(self) -> list[NestedKey]:
        """Names of the three terms."""
        return ["loss_reconstruction", "loss_kl", "loss_action"]

    def terms(
        self, observation: Tensor, action: Tensor, following: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The three terms, for one sample of z."""
        reward = self.reward
        check_transitions(reward.scaler, reward.actions, observation, action, following)
        observation, following = reward.scaler(observation), reward.scaler(following)
        mu, logvar = reward.encode(observation, following)
        z = mu + (0.5 * logvar).exp() * torch.randn_like(mu)
        error = reconstruction_error(
            reward.decode(z, observation), following, reward.scaler.event_dims
        )
        kl = gaussian_kl(mu, logvar, *reward.prior(observation))
        return (
            reward.scale * error,
            kl,
            self.alpha * action_term(z, reward.actions.target(action)),
        )
