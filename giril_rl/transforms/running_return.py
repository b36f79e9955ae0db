"""The discounted return in each environment and its moments in all, step by step without a loop."""

from __future__ import annotations

import torch
from torch import Tensor

BLOCK = 128


def discounted_filter(
    reward: Tensor, done: Tensor | None, carry: Tensor, gamma: float
) -> tuple[Tensor, Tensor]:
    """``R_t = gamma * R_{t-1} + r_t``, where ``R_{t-1}`` counts as 0 after an episode's end.

    Args:
        reward: ``(M, T)``, M environments over T steps.
        done: ``(M, T)`` bool, whether the episode ended with this step; None never resets.
        carry: ``(M,)``, the filter's value before the first step.
        gamma: discount, in [0, 1].

    Returns:
        R ``(M, T)``, and the carry ``(M,)`` for the next batch, 0 where the last step was done.

    Examples:
        >>> discounted_filter(torch.tensor([[1.0, 1.0, 1.0]]), None, torch.tensor([4.0]), 0.5)
        (tensor([[3.0000, 2.5000, 2.2500]]), tensor([2.2500]))
    """
    steps = reward.shape[1]
    if steps == 0:
        return reward, carry
    size = min(BLOCK, steps)
    index = torch.arange(size + 1, device=reward.device)
    powers = torch.full((), gamma, dtype=reward.dtype, device=reward.device) ** index
    # weights[j, i] = gamma^(i - j), the weight of the reward of step j at step i of its block.
    weights = powers[(index[:-1] - index[:-1, None]).clamp_min(0)].triu()
    blocks = []
    for block in reward.split(size, dim=1):
        length = block.shape[1]
        values = block @ weights[:length, :length] + carry[:, None] * powers[1 : length + 1]
        blocks.append(values)
        carry = values[:, -1]
    filtered = torch.cat(blocks, 1)
    if done is None:
        return filtered, carry
    return _forget(filtered, done, gamma)


def _forget(filtered: Tensor, done: Tensor, gamma: float) -> tuple[Tensor, Tensor]:
    """Subtracts what came before an episode's start: ``R_t - gamma^(t - k) * R_k``."""
    time = torch.arange(filtered.shape[1], device=filtered.device)
    ends = torch.where(done, time, -1).cummax(1).values
    last_end = torch.cat((torch.full_like(ends[:, :1], -1), ends[:, :-1]), 1)
    base = torch.full((), gamma, dtype=filtered.dtype, device=filtered.device)
    old = base ** (time - last_end) * filtered.gather(1, last_end.clamp_min(0))
    forgetful = filtered - torch.where(last_end >= 0, old, 0.0)
    return forgetful, torch.where(done[:, -1], 0.0, forgetful[:, -1])


def running_moments(
    values: Tensor, count: Tensor, mean: Tensor, m2: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Count, mean and sum of squared deviations after each step, all environments pooled.

    Each step's sample is merged as in Chan, Golub and LeVeque (1979), but without a loop.

    Args:
        values: ``(M, T)``.
        count: number of values seen before, a scalar (like mean and m2).
        mean: their mean.
        m2: the sum of their squared deviations from the mean; the variance is ``m2 / count``.

    Returns:
        Three tensors of shape ``(T,)``: count, mean and m2 after each step.

    Examples:
        >>> zero = torch.tensor(0.0)
        >>> running_moments(torch.tensor([[1.0, 3.0]]), zero, zero, zero)
        (tensor([1., 2.]), tensor([1., 2.]), tensor([0., 2.]))
    """
    envs, steps = values.shape
    if steps == 0:
        return count.expand(0), mean.expand(0), m2.expand(0)
    step_mean = values.mean(0)
    within = (values - step_mean).square().sum(0)
    total = count + envs * torch.arange(1, steps + 1, device=values.device, dtype=values.dtype)
    # Sums relative to the first step's mean keep their digits when the level is high.
    shift = step_mean[0]
    sums = (step_mean - shift).cumsum(0) * envs
    new_mean = shift + ((mean - shift) * count + sums) / total
    old_mean = torch.cat((mean.reshape(1), new_mean[:-1]))
    between = (step_mean - old_mean).square() * ((total - envs) * envs / total)
    return total, new_mean, m2 + (within + between).cumsum(0)
