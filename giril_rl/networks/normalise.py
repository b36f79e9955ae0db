"""Running normalisation of observations, a part of the policy that is saved with it."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from giril_rl.errors import UserError


class RunningNormaliser(nn.Module):
    """Subtracts the running mean, divides by the running standard deviation, clips.

    The statistics change only in :meth:`update`, once for a whole batch and after PPO has used it,
    so that the probabilities recorded while collecting are those of the very policy that collected.
    TorchRL's ``VecNormV2`` updates at every environment step instead, and keeps the statistics in
    the environment rather than with the policy that cannot do without them. The clipping at 10 and
    the first count of 1e-4 are those of OpenAI baselines' ``VecNormalize``.

    Args:
        size: size of the last dimension.
        clip: bound on the normalised value.
        eps: added to the variance.

    Examples:
        >>> import torch
        >>> normalise = RunningNormaliser(2)
        >>> normalise.update(torch.tensor([[0.0, 10.0], [2.0, 30.0]]))
        >>> normalise(torch.tensor([2.0, 10.0])).round(decimals=2)
        tensor([ 1., -1.])

    Raises:
        UserError: for observations of another size.
    """

    event_dims = 1
    """Dimensions of one observation."""

    mean: Tensor
    var: Tensor
    count: Tensor
    shift: Tensor
    factor: Tensor

    def __init__(self, size: int, *, clip: float = 10.0, eps: float = 1e-8) -> None:
        super().__init__()
        self.clip = clip
        self.eps = eps
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("var", torch.ones(size, dtype=torch.float64))
        self.register_buffer("count", torch.tensor(1e-4, dtype=torch.float64))
        self.register_buffer("shift", torch.zeros(size))
        self.register_buffer("factor", torch.ones(size))

    def forward(self, observation: Tensor) -> Tensor:
        """Normalises ``(*batch, size)`` of any real dtype."""
        check_size(observation, self.shift)
        observation = observation.to(self.shift.dtype)
        return ((observation - self.shift) * self.factor).clamp_(-self.clip, self.clip)

    @torch.no_grad()
    def fit(self, observation: Tensor, *, least: float = 0.0) -> None:
        """Replaces the statistics by those of ``(*batch, size)`` alone.

        Args:
            observation: raw observations.
            least: smallest deviation to divide by. A good player hardly moves some of its
                observations; divided by so little, what it never saw would be far out of range.

        Raises:
            UserError: for another size, NaN or infinity; the statistics are then as they were.
        """
        check_size(observation, self.mean)
        _check_finite(observation)
        batch = observation.reshape(-1, observation.shape[-1]).double()
        self.mean.copy_(batch.mean(0))
        self.var.copy_(batch.var(0, correction=0).clamp(min=least**2))
        self.count.fill_(len(batch))
        self.shift.copy_(self.mean)
        self.factor.copy_((self.var + self.eps).rsqrt())

    @torch.no_grad()
    def update(self, observation: Tensor) -> None:
        """Merges ``(*batch, size)`` into the statistics (Chan et al. 1983).

        Raises:
            UserError: for another size, NaN or infinity; the statistics are then as they were.
        """
        check_size(observation, self.mean)
        _check_finite(observation)
        batch = observation.reshape(-1, observation.shape[-1]).double()
        n = batch.shape[0]
        total = self.count + n
        delta = batch.mean(0) - self.mean
        self.var.mul_(self.count).add_(batch.var(0, correction=0) * n)
        self.var.add_(delta.square() * self.count * n / total).div_(total)
        self.mean.add_(delta * n / total)
        self.count.copy_(total)
        self.shift.copy_(self.mean)
        self.factor.copy_((self.var + self.eps).rsqrt())


def check_size(observation: Tensor, statistics: Tensor) -> None:
    """Refuses observations that statistics of another size would broadcast.

    Args:
        observation: ``(*batch, size)``.
        statistics: ``(size,)``.

    Raises:
        UserError: for another size.

    Examples:
        >>> import torch
        >>> check_size(torch.zeros(7, 1), torch.zeros(3))
        Traceback (most recent call last):
        giril_rl.errors.UserError: observations have shape (7, 1) where (*batch, 3) is needed.
    """
    if observation.shape[-1:] != statistics.shape:
        raise UserError(
            f"observations have shape {tuple(observation.shape)} where (*batch, "
            f"{statistics.shape[0]}) is needed."
        )


def _check_finite(observation: Tensor) -> None:
    finite = observation.isfinite()
    if not finite.all():
        *where, entry = (~finite).nonzero()[0].tolist()
        value = observation[(*where, entry)].item()
        raise UserError(
            f"an observation is not finite: {value} at entry {entry} of the one at {where} in the "
            "batch, where running statistics would keep it for ever; mend the environment or data."
        )
