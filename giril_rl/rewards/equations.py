"""Equation 2 of the paper, in two pure functions."""

from __future__ import annotations

from torch import Tensor


def reconstruction_error(predicted: Tensor, target: Tensor, dims: int = 1) -> Tensor:
    """The squared L2 norm of ``predicted - target`` of each observation (paper, eq. 2).

    Times lambda it is also ``-log p(s' | z, s)`` up to a constant (eq. 1's first term).

    Args:
        predicted: ``(*batch, *observation)``.
        target: of the same shape.
        dims: dimensions of one observation, the last ones: 1 for a vector, 3 for frames.

    Examples:
        >>> import torch
        >>> reconstruction_error(torch.tensor([[1.0, 2.0]]), torch.tensor([[0.0, 4.0]]))
        tensor([5.])
    """
    return (predicted - target).square().flatten(-dims).sum(-1)


def blend_action(action_code: Tensor, encoded: Tensor, beta: float) -> Tensor:
    """``beta * a + (1 - beta) * a_hat``, what the decoder gets at reward time (paper, eq. 2).

    Examples:
        >>> import torch
        >>> blend_action(torch.tensor([1.0, 0.0]), torch.tensor([0.5, 0.5]), 0.5)
        tensor([0.7500, 0.2500])
    """
    return beta * action_code + (1 - beta) * encoded
