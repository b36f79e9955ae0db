"""Bodies for stacks of 84x84 frames: encoder, ICM's networks, and the convolutions they share."""

from __future__ import annotations

from typing import TypeVar

import torch
from torch import Tensor, nn

from giril_rl.errors import UserError
from giril_rl.networks.joined import JoinedSequential

SIDE = 84
"""Height and width of a frame."""
FEATURES = 1024
"""Size of the convolutions' flattened output, 64x4x4."""
SLOPE = 0.01
"""LeakyReLU's slope below 0."""

Network = TypeVar("Network", bound=nn.Module)


def conv_stack(channels: int) -> nn.Sequential:
    """Four times [3x3 convolution of stride 2, BatchNorm, LeakyReLU], flattened (paper, Table 2).

    32, 32, 64 and 64 channels, no padding: 84 -> 41 -> 20 -> 9 -> 4. Xavier-uniform weights.

    Args:
        channels: channels of the input.

    Returns:
        A module mapping ``(N, channels, 84, 84)`` to ``(N, 1024)``; its last layer flattens.

    Examples:
        >>> conv_stack(8)(torch.zeros(2, 8, 84, 84)).shape
        torch.Size([2, 1024])
    """
    layers: list[nn.Module] = []
    for width in (32, 32, 64, 64):
        layers += [
            nn.Conv2d(channels, width, 3, stride=2),
            nn.BatchNorm2d(width),
            nn.LeakyReLU(SLOPE),
        ]
        channels = width
    return xavier(nn.Sequential(*layers, nn.Flatten()))


def xavier(network: Network) -> Network:
    """Xavier-uniform weights and zero biases for all linear and convolutional layers, in place.

    Examples:
        >>> xavier(nn.Linear(2, 1)).bias.tolist()
        [0.0]
    """
    for layer in network.modules():
        if isinstance(layer, (nn.Linear, nn.Conv2d, nn.ConvTranspose2d)):
            nn.init.xavier_uniform_(layer.weight)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
    return network


def flat_frames(observation: Tensor, channels: int) -> Tensor:
    """Observations ``(*batch, channels, 84, 84)`` as ``(N, channels, 84, 84)``.

    Floats, which go to convolutions as they are, have their channels last in memory then: a CPU's
    convolutions and batch normalisations train in two thirds of the time.

    Raises:
        UserError: for another number of channels or another side.

    Examples:
        >>> flat_frames(torch.zeros(2, 3, 4, 84, 84), 4).shape
        torch.Size([6, 4, 84, 84])
    """
    shape = (channels, SIDE, SIDE)
    if tuple(observation.shape[-3:]) != shape:
        raise UserError(
            f"a pixel network takes observations of shape (*batch, {channels}, {SIDE}, {SIDE}), "
            f"not {tuple(observation.shape)}: resize the frames and stack {channels} of them."
        )
    frames = observation.reshape(-1, *shape)
    if frames.is_floating_point():
        return frames.contiguous(memory_format=torch.channels_last)
    return frames


class PixelEncoder(nn.Module):
    """GIRIL's encoder for pixels: mean and log-variance of z (paper, Table 2).

    ``cat(s, s')`` through :func:`conv_stack`, then one linear layer for both; it is initialised as
    the two layers that the paper has.

    Args:
        actions: number of actions, the size of z.
        channels: frames in an observation.

    Examples:
        >>> s = torch.zeros(2, 4, 84, 84)
        >>> PixelEncoder(6)(s, s).shape
        torch.Size([2, 12])
    """

    def __init__(self, actions: int, channels: int = 4) -> None:
        super().__init__()
        self.channels = channels
        self.body = conv_stack(2 * channels)
        self.head = nn.Linear(FEATURES, 2 * actions)
        for half in self.head.weight.chunk(2):
            nn.init.xavier_uniform_(half)
        nn.init.zeros_(self.head.bias)

    def forward(self, observation: Tensor, following: Tensor) -> Tensor:
        """``(*batch, 2 * actions)`` for s and s' scaled to [-1, 1], ``(*batch, 4, 84, 84)``."""
        frames = [flat_frames(x, self.channels) for x in (observation, following)]
        out = self.head(self.body(torch.cat(frames, 1)))
        return out.reshape(*observation.shape[:-3], *out.shape[1:])


class PixelPrior(nn.Module):
    """GIRIL's conditional prior for pixels: mean and log-variance of ``p(z | s)`` (paper, eq. 1).

    Args:
        actions: number of actions, the size of z.
        channels: frames in an observation.

    Examples:
        >>> PixelPrior(6)(torch.zeros(2, 4, 84, 84)).shape
        torch.Size([2, 12])
    """

    def __init__(self, actions: int, channels: int = 4) -> None:
        super().__init__()
        self.features = PixelFeatures(channels)
        self.head = xavier(nn.Linear(FEATURES, 2 * actions))

    def forward(self, observation: Tensor) -> Tensor:
        """``(*batch, 2 * actions)`` for observations scaled to [-1, 1]."""
        return self.head(self.features(observation))


class PixelFeatures(nn.Module):
    """ICM's features phi for pixels: :func:`conv_stack` of one observation (paper, Table 2).

    Args:
        channels: frames in an observation.

    Examples:
        >>> PixelFeatures()(torch.zeros(2, 3, 4, 84, 84)).shape
        torch.Size([2, 3, 1024])
    """

    def __init__(self, channels: int = 4) -> None:
        super().__init__()
        self.channels = channels
        self.body = conv_stack(channels)

    def forward(self, observation: Tensor) -> Tensor:
        """``(*batch, 1024)`` for observations scaled to [-1, 1], ``(*batch, 4, 84, 84)``."""
        features = self.body(flat_frames(observation, self.channels))
        return features.reshape(*observation.shape[:-3], FEATURES)


class InverseModel(JoinedSequential):
    """ICM's logits of the action, from ``phi(s), phi(s')``: 2048 -> 64 -> actions (paper, Table 2).

    Args:
        actions: number of actions.
        features: size of phi.

    Examples:
        >>> InverseModel(6)(torch.zeros(2, 1024), torch.zeros(2, 1024)).shape
        torch.Size([2, 6])
    """

    def __init__(self, actions: int, features: int = FEATURES) -> None:
        super().__init__(nn.Linear(2 * features, 64), nn.LeakyReLU(SLOPE), nn.Linear(64, actions))
        xavier(self)


class ForwardModel(JoinedSequential):
    """ICM's ``phi_hat(s')``, from ``phi(s), a``: 1024 + actions -> 64 -> 1024 (paper, Table 2).

    Args:
        actions: number of actions.
        features: size of phi.

    Examples:
        >>> ForwardModel(6)(torch.zeros(2, 1024), torch.zeros(2, 6)).shape
        torch.Size([2, 1024])
    """

    def __init__(self, actions: int, features: int = FEATURES) -> None:
        super().__init__(
            nn.Linear(features + actions, 64), nn.LeakyReLU(SLOPE), nn.Linear(64, features)
        )
        xavier(self)
