"""Running normalisation of observations, and batch normalisation by its running statistics."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from giril_rl.errors import UserError


class RunningNormaliser(nn.Module):
    """Subtracts the running mean, divides by the running standard deviation, clips.

    The statistics change only in :meth:`update`, once per batch, after PPO has used it. So the
    recorded action probabilities are those of the policy that collected. TorchRL's ``VecNormV2``
    updates at every environment step and keeps the statistics in the environment, while the policy
    cannot do without them. The clipping at 10 and the initial count of 1e-4 are those of OpenAI
    baselines' ``VecNormalize``.

    Args:
        size: size of the last dimension.
        clip: bound on the normalised value.
        eps: added to the variance.

    Raises:
        UserError: for observations of another size.

    Examples:
        >>> normalise = RunningNormaliser(2)
        >>> normalise.update(torch.tensor([[0.0, 10.0], [2.0, 30.0]]))
        >>> normalise(torch.tensor([2.0, 10.0])).round(decimals=2)
        tensor([ 1., -1.])
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
            least: smallest standard deviation to divide by. A good player hardly moves some of its
                observations. Divided by so little, unseen values would be far out of range.

        Raises:
            UserError: for another size, NaN or infinity; the statistics then stay as they were.
        """
        batch = self._checked(observation)
        self.mean.copy_(batch.mean(0))
        self.var.copy_(batch.var(0, correction=0).clamp(min=least**2))
        self.count.fill_(len(batch))
        self._refresh()

    @torch.no_grad()
    def update(self, observation: Tensor) -> None:
        """Merges ``(*batch, size)`` into the statistics (Chan et al. 1983).

        Raises:
            UserError: for another size, NaN or infinity; the statistics then stay as they were.
        """
        batch = self._checked(observation)
        n = batch.shape[0]
        total = self.count + n
        delta = batch.mean(0) - self.mean
        self.var.mul_(self.count).add_(batch.var(0, correction=0) * n)
        self.var.add_(delta.square() * self.count * n / total).div_(total)
        self.mean.add_(delta * n / total)
        self.count.copy_(total)
        self._refresh()

    def _checked(self, observation: Tensor) -> Tensor:
        check_size(observation, self.mean)
        _check_finite(observation)
        return observation.reshape(-1, observation.shape[-1]).double()

    def _refresh(self) -> None:
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
        >>> check_size(torch.zeros(7, 1), torch.zeros(3))
        Traceback (most recent call last):
        giril_rl.errors.UserError: observations have shape (7, 1) where (*batch, 3) is needed.
    """
    if observation.shape[-1:] != statistics.shape:
        raise UserError(
            f"observations have shape {tuple(observation.shape)} where (*batch, "
            f"{statistics.shape[0]}) is needed."
        )


@contextmanager
def running_statistics(module: nn.Module) -> Iterator[None]:
    """Inside, ``module``'s batch normalisations use their running statistics and keep them as is.

    Each sample's output then depends on that sample alone, which per-sample gradients need.

    Args:
        module: any module.

    Examples:
        >>> norm = nn.BatchNorm1d(1, affine=False, eps=0.0)
        >>> with running_statistics(norm):
        ...     norm(torch.tensor([[5.0], [7.0]])).flatten()
        tensor([5., 7.])
        >>> norm.training, norm.num_batches_tracked
        (True, tensor(0))
    """
    training = [part for part in module.modules() if isinstance(part, _BatchNorm) and part.training]
    for part in training:
        part.training = False
    try:
        yield
    finally:
        for part in training:
            part.training = True


def _check_finite(observation: Tensor) -> None:
    finite = observation.isfinite()
    if not finite.all():
        *where, entry = (~finite).nonzero()[0].tolist()
        value = observation[(*where, entry)].item()
        raise UserError(
            f"an observation is not finite: {value} at entry {entry} of the one at {where} in the "
            "batch, and running statistics would keep it for ever; mend the environment or data."
        )
