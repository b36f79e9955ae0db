"""Discriminators of an observation of pixels and an action."""

from __future__ import annotations

from typing import cast

import torch.nn.functional as F
from torch import Tensor, nn

from giril_rl.networks.pixels import FEATURES, conv_stack, flat_frames, xavier


class PixelPairNetwork(nn.Module):
    """The encoder's convolutions on the frames and, for each action, a plane of its code.

    A plane of one value is the same under every position of an unpadded kernel, so each plane is
    worth its value times the sum of its kernel: the planes themselves are never made.

    Args:
        actions: number of actions, the size of the code.
        channels: frames in an observation.
        head: layers from the last convolution's 64x4x4 on.

    Examples:
        >>> import torch
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

    def forward(self, observation: Tensor, code: Tensor) -> Tensor:
        """The head's output ``(*batch, features)``.

        Args:
            observation: scaled to [-1, 1], ``(*batch, channels, 84, 84)``.
            code: the action's code, one-hot or not, ``(*batch, actions)``.
        """
        frames = flat_frames(observation, self.channels)
        weight = self.first.weight
        planes = code.reshape(-1, code.shape[-1]) @ weight[:, self.channels :].sum((-2, -1)).T
        out = F.conv2d(frames, weight[:, : self.channels], self.first.bias, stride=2)
        out = self.head(self.rest(out + planes[..., None, None]))
        return out.reshape(*observation.shape[:-3], *out.shape[1:])


class PixelDiscriminator(PixelPairNetwork):
    """GAIL's discriminator for pixels: one logit (paper, appendix).

    Args:
        actions: number of actions.
        out_features: numbers per pair.
        channels: frames in an observation.

    Examples:
        >>> import torch
        >>> PixelDiscriminator(6)(torch.zeros(2, 4, 84, 84), torch.zeros(2, 6)).shape
        torch.Size([2, 1])
    """

    def __init__(self, actions: int, out_features: int = 1, channels: int = 4) -> None:
        super().__init__(actions, channels, nn.Flatten(), nn.Linear(FEATURES, out_features))


class PixelBottleneck(PixelPairNetwork):
    """VAIL's encoder for pixels: mean and log-variance, by a 4x4 convolution (paper, appendix).

    Args:
        actions: number of actions.
        latent: size of the bottleneck's code.
        channels: frames in an observation.

    Examples:
        >>> import torch
        >>> PixelBottleneck(6, latent=8)(torch.zeros(2, 4, 84, 84), torch.zeros(2, 6)).shape
        torch.Size([2, 16])
    """

    def __init__(self, actions: int, latent: int, channels: int = 4) -> None:
        super().__init__(actions, channels, nn.Conv2d(64, 2 * latent, 4), nn.Flatten())
