"""Networks for stacks of 84x84 frames: GIRIL's encoder and prior, ICM's, the discriminators."""

from __future__ import annotations

from typing import TypeVar, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torchrl.modules import MLP

from giril_rl.errors import UserError

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

    Floats come back channels-last in memory: on a CPU, convolutions and batch normalisation then
    train in two thirds of the time.

    Raises:
        UserError: for another number of channels or another frame size.

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
    """GIRIL's encoder: mean and log-variance of z (paper, Table 2).

    ``cat(s, s')`` goes through :func:`conv_stack`, then through one linear layer, which is
    initialised as the paper's two separate ones.

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

    def forward(self, observation: Tensor, next_observation: Tensor) -> Tensor:
        """``(*batch, 2 * actions)`` for s and s' scaled to [-1, 1], ``(*batch, 4, 84, 84)``."""
        frames = [flat_frames(x, self.channels) for x in (observation, next_observation)]
        out = self.head(self.body(torch.cat(frames, 1)))
        return out.reshape(*observation.shape[:-3], *out.shape[1:])


class PixelFeatures(nn.Module):
    """ICM's features phi: :func:`conv_stack` of one observation (paper, Table 2).

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


class PixelPrior(nn.Module):
    """GIRIL's conditional prior: mean and log-variance of ``p(z | s)`` (paper, eq. 1).

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


class InverseModel(MLP):
    """ICM's action logits from ``phi(s), phi(s')``: 2048 -> 64 -> actions (paper, Table 2).

    Examples:
        >>> InverseModel(6)(torch.zeros(2, 1024), torch.zeros(2, 1024)).shape
        torch.Size([2, 6])
    """

    def __init__(self, actions: int, features: int = FEATURES) -> None:
        super().__init__(2 * features, actions, num_cells=[64], activation_class=nn.LeakyReLU)
        xavier(self)


class ForwardModel(MLP):
    """ICM's ``phi_hat(s')`` from ``phi(s), a``: 1024 + actions -> 64 -> 1024 (paper, Table 2).

    Examples:
        >>> ForwardModel(6)(torch.zeros(2, 1024), torch.zeros(2, 6)).shape
        torch.Size([2, 1024])
    """

    def __init__(self, actions: int, features: int = FEATURES) -> None:
        sizes = features + actions, features
        super().__init__(*sizes, num_cells=[64], activation_class=nn.LeakyReLU)
        xavier(self)


class PixelPairNetwork(nn.Module):
    """The encoder's convolutions on the frames plus, for each action, one constant plane.

    A constant plane looks the same under every position of an unpadded kernel. So it adds its
    value times the sum of its kernel, and the planes themselves are never made.

    Args:
        actions: number of actions, the size of the action encoding.
        channels: frames in an observation.
        head: the layers after the last convolution's 64x4x4.

    Examples:
        >>> network = PixelPairNetwork(6, 4, nn.Flatten())
        >>> network(torch.zeros(2, 4, 84, 84), torch.zeros(2, 6)).shape
        torch.Size([2, 1024])
    """

    def __init__(self, actions: int, channels: int, *head: nn.Module) -> None:
        super().__init__()
        self.channels = channels
        stack = conv_stack(channels + actions)
        self.first = cast(nn.Conv2d, stack[0])
        self.rest = stack[1:-1]
        self.head = xavier(nn.Sequential(*head))

    def forward(self, observation: Tensor, encoding: Tensor) -> Tensor:
        """The head's output ``(*batch, features)``.

        Args:
            observation: scaled to [-1, 1], ``(*batch, channels, 84, 84)``.
            encoding: the encoded action, ``(*batch, actions)``.
        """
        frames = flat_frames(observation, self.channels)
        weight = self.first.weight
        kernel_sums = weight[:, self.channels :].sum((-2, -1))
        planes = encoding.reshape(len(frames), encoding.shape[-1]) @ kernel_sums.T
        out = F.conv2d(frames, weight[:, : self.channels], self.first.bias, stride=2)
        out = self.head(self.rest(out + planes[..., None, None]))
        return out.reshape(*observation.shape[:-3], *out.shape[1:])


class PixelDiscriminator(PixelPairNetwork):
    """GAIL's discriminator: one logit (paper, appendix).

    Args:
        actions: number of actions.
        out_features: numbers per pair.
        channels: frames in an observation.

    Examples:
        >>> PixelDiscriminator(6)(torch.zeros(2, 4, 84, 84), torch.zeros(2, 6)).shape
        torch.Size([2, 1])
    """

    def __init__(self, actions: int, out_features: int = 1, channels: int = 4) -> None:
        super().__init__(actions, channels, nn.Flatten(), nn.Linear(FEATURES, out_features))


class PixelBottleneck(PixelPairNetwork):
    """VAIL's encoder: mean and log-variance of z, by a 4x4 convolution (paper, appendix).

    Args:
        actions: number of actions.
        latent: size of z.
        channels: frames in an observation.

    Examples:
        >>> PixelBottleneck(6, latent=8)(torch.zeros(2, 4, 84, 84), torch.zeros(2, 6)).shape
        torch.Size([2, 16])
    """

    def __init__(self, actions: int, latent: int, channels: int = 4) -> None:
        super().__init__(actions, channels, nn.Conv2d(64, 2 * latent, 4), nn.Flatten())
