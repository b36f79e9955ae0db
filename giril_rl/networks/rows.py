"""Convolutions to a few channels, computed for neighbouring rows at once."""

from __future__ import annotations

from torch import Tensor

ROWS = 4
"""Neighbouring rows that are computed at once, as channels."""


def rows_kernel(weight: Tensor, dilation: int = 1) -> Tensor:
    """The kernel that computes four rows at once, an output channel for each.

    Four output channels leave most of a CPU's vector unit idle. As 16, with a stride of four rows
    and a kernel over all that the four rows read, they fill it.

    Args:
        weight: a convolution's, ``(out, channels, height, width)``.
        dilation: between the rows that it reads.

    Returns:
        ``(out * 4, channels, 3 + rows read, width)``, for a stride of four rows and no dilation
        of rows.

    Examples:
        >>> import torch
        >>> rows_kernel(torch.tensor([[[[1.0], [2.0]]]])).squeeze()
        tensor([[1., 2., 0., 0., 0.],
                [0., 1., 2., 0., 0.],
                [0., 0., 1., 2., 0.],
                [0., 0., 0., 1., 2.]])
    """
    out, channels, height, width = weight.shape
    read = dilation * (height - 1) + 1
    packed = weight.new_zeros(out, ROWS, channels, read + ROWS - 1, width)
    for row in range(ROWS):
        packed[:, row, :, row : row + read : dilation] = weight
    return packed.flatten(0, 1)
