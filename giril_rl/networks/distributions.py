"""Lean action distributions for PPO.

They compute what ``torch.distributions`` does, as the tests check, without its argument checks and
broadcasting, which at these network sizes cost as much as the network.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

HALF_LOG_TWO_PI = 0.5 * math.log(2 * math.pi)


class DiagonalGaussian:
    """Independent normals; one event is the last dimension.

    Args:
        mean: ``(*batch, action_dim)``.
        log_std: ``(action_dim,)``, independent of the state.

    Examples:
        >>> d = DiagonalGaussian(torch.zeros(3, 1), torch.zeros(1))
        >>> d.log_prob(torch.zeros(3, 1))
        tensor([-0.9189, -0.9189, -0.9189])
    """

    def __init__(self, mean: Tensor, log_std: Tensor) -> None:
        self.mean = mean
        self.log_std = log_std

    @property
    def mode(self) -> Tensor:
        """The most likely action, ``(*batch, action_dim)``."""
        return self.mean

    def sample(self) -> Tensor:
        """One draw, ``(*batch, action_dim)``, without gradient."""
        with torch.no_grad():
            return torch.addcmul(self.mean, torch.randn_like(self.mean), self.log_std.exp())

    def log_prob(self, action: Tensor) -> Tensor:
        """Log density, ``(*batch,)``."""
        scaled = (action - self.mean) * (-self.log_std).exp()
        constant = HALF_LOG_TWO_PI * self.log_std.shape[-1]
        return scaled.square().sum(-1) * -0.5 - (self.log_std.sum() + constant)

    def clamped_log_prob(self, draw: Tensor, at_low: Tensor, at_high: Tensor) -> Tensor:
        """Log-probability ``(*batch,)`` of a draw that was clamped to bounds.

        Inside the bounds it is the log density. A dimension at a bound has the log-probability of
        all draws beyond it, however far.

        Args:
            draw: the clamped draw, ``(*batch, action_dim)``.
            at_low: whether it is at the lower bound, of the same shape.
            at_high: whether it is at the upper one.

        Examples:
            >>> d = DiagonalGaussian(torch.zeros(2, 1), torch.zeros(1))
            >>> at_high = torch.tensor([[False], [True]])
            >>> d.clamped_log_prob(torch.zeros(2, 1), torch.tensor(False), at_high).exp()
            tensor([0.3989, 0.5000])
        """
        scaled = (draw - self.mean) * (-self.log_std).exp()
        inside = scaled.square() * -0.5 - (self.log_std + HALF_LOG_TWO_PI)
        beyond = torch.special.log_ndtr(torch.where(at_high, -scaled, scaled))
        return torch.where(at_low | at_high, beyond, inside).sum(-1)

    def entropy(self) -> Tensor:
        """Differential entropy, ``(*batch,)``."""
        size = self.log_std.shape[-1]
        return (self.log_std.sum() + size * (0.5 + HALF_LOG_TWO_PI)).expand(self.mean.shape[:-1])


class CategoricalActions:
    """A categorical distribution over integer actions.

    Args:
        logits: ``(*batch, actions)``, not normalised.

    Examples:
        >>> CategoricalActions(torch.zeros(2, 4)).log_prob(torch.tensor([0, 3]))
        tensor([-1.3863, -1.3863])
    """

    def __init__(self, logits: Tensor) -> None:
        self.log_probabilities = logits.log_softmax(-1)

    @property
    def mode(self) -> Tensor:
        """The most likely action, ``(*batch,)``."""
        return self.log_probabilities.argmax(-1)

    def sample(self) -> Tensor:
        """One draw, ``(*batch,)`` int64 (the Gumbel-max trick)."""
        with torch.no_grad():
            noise = torch.empty_like(self.log_probabilities).exponential_().log_()
            return (self.log_probabilities - noise).argmax(-1)

    def log_prob(self, action: Tensor) -> Tensor:
        """Log probability, ``(*batch,)``."""
        return self.log_probabilities.gather(-1, action.unsqueeze(-1)).squeeze(-1)

    def entropy(self) -> Tensor:
        """Entropy in nats, ``(*batch,)``."""
        return -(self.log_probabilities.exp() * self.log_probabilities).sum(-1)


class OneHotActions(CategoricalActions):
    """The same distribution over one-hot actions.

    Examples:
        >>> OneHotActions(torch.tensor([0.0, 1.0])).mode
        tensor([0, 1])
    """

    @property
    def mode(self) -> Tensor:
        """The most likely action, ``(*batch, actions)``."""
        return self._one_hot(super().mode)

    def sample(self) -> Tensor:
        """One draw, ``(*batch, actions)`` int64, by the same random numbers."""
        return self._one_hot(super().sample())

    def log_prob(self, action: Tensor) -> Tensor:
        """Log probability ``(*batch,)`` of one-hot actions of any dtype."""
        return super().log_prob(action.long().argmax(-1))

    def _one_hot(self, index: Tensor) -> Tensor:
        # Not F.one_hot, which looks at the values and so cannot be recorded as a graph.
        zeros = torch.zeros_like(self.log_probabilities, dtype=torch.int64)
        return zeros.scatter(-1, index.unsqueeze(-1), 1)
