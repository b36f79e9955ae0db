"""Rewards of many transitions, some at a time."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


def in_chunks(
    function: Callable[..., Tensor], inputs: tuple[Tensor, ...], batch: torch.Size, size: int | None
) -> Tensor:
    """``function(*inputs)``, for batches of pixels, which would take gigabytes at once.

    Args:
        function: maps tensors of any leading shape to one number for each element of it.
        inputs: tensors ``(*batch, ...)``.
        batch: their leading shape.
        size: most elements at a time; None takes all at once.

    Returns:
        A tensor of shape ``batch``.

    Examples:
        >>> double = lambda x: 2 * x.sum(-1)
        >>> in_chunks(double, (torch.ones(2, 3, 5),), torch.Size([2, 3]), size=4).shape
        torch.Size([2, 3])
    """
    if size is None or batch.numel() <= size:
        return function(*inputs)
    flat = [tensor.flatten(0, len(batch) - 1) for tensor in inputs]
    parts = zip(*(tensor.split(size) for tensor in flat), strict=True)
    return torch.cat([function(*part) for part in parts]).reshape(batch)


def per_transition(
    function: Callable[..., Tensor], inputs: tuple[Tensor, ...], event_dims: int
) -> Tensor:
    """``function(*inputs)``, one number per transition; of frames :data:`PIXELS_AT_ONCE` at a time.

    Args:
        function: maps tensors of any leading shape to one number for each element of it.
        inputs: an observation ``(*batch, ...)`` first, then what else belongs to the transitions.
        event_dims: dimensions of one observation: 1 for vectors, 3 for frames.

    Examples:
        >>> per_transition(lambda x: x.sum(-1), (torch.ones(2, 3, 5),), event_dims=1).shape
        torch.Size([2, 3])
    """
    batch = inputs[0].shape[: inputs[0].ndim - event_dims]
    return in_chunks(function, inputs, batch, PIXELS_AT_ONCE if event_dims == 3 else None)


PIXELS_AT_ONCE = 256
"""Transitions of frames that a network takes at a time."""
