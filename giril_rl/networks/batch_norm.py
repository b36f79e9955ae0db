"""Batch normalisation by its running statistics, while the rest of a module trains."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from torch import nn
from torch.nn.modules.batchnorm import _BatchNorm


@contextmanager
def running_statistics(module: nn.Module) -> Iterator[None]:
    """Within it, ``module``'s batch normalisations use their running statistics and leave them be.

    Each sample's output is then a function of that sample alone, as a gradient of single samples
    needs.

    Args:
        module: any module; one without batch normalisation is left as it is.

    Examples:
        >>> import torch
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
