"""A sequence of layers that takes its input in parts."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class JoinedSequential(nn.Sequential):
    """``nn.Sequential`` whose inputs are concatenated on their last dimension first.

    Parameters have the names that ``nn.Sequential`` gives them.

    Examples:
        >>> JoinedSequential(nn.Linear(5, 2))(torch.zeros(7, 3), torch.zeros(7, 2)).shape
        torch.Size([7, 2])
    """

    def forward(self, *inputs: Tensor) -> Tensor:
        """The last layer's output for inputs ``(*batch, d_1), (*batch, d_2), ...``."""
        return super().forward(torch.cat(inputs, -1))
