"""Bodies for vector observations: two hidden layers of 100, tanh (paper, section 5.2)."""

from __future__ import annotations

from collections.abc import Sequence

from torch import nn


def mlp(in_features: int, out_features: int, hidden: Sequence[int] = (100, 100)) -> nn.Sequential:
    """A fully connected network with tanh between its layers and a linear output.

    Args:
        in_features: size of the last dimension of the input.
        out_features: size of the last dimension of the output.
        hidden: sizes of the hidden layers; the paper uses two of 100.

    Returns:
        A module mapping ``(*batch, in_features)`` to ``(*batch, out_features)``.

    Examples:
        >>> import torch
        >>> mlp(5, 1)(torch.zeros(7, 5)).shape
        torch.Size([7, 1])
    """
    layers: list[nn.Module] = []
    size = in_features
    for width in hidden:
        layers += [nn.Linear(size, width), nn.Tanh()]
        size = width
    layers.append(nn.Linear(size, out_features))
    return nn.Sequential(*layers)
