"""Transitions of random frames, and the pixel networks' layers written out."""

import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import nn

ACTIONS = 4


def transitions(*batch, side=84, seed=0):
    """Random stacks of four frames and actions."""
    generator = torch.Generator().manual_seed(seed)
    shape = (*batch, 4, side, side)
    s, following = (
        torch.randint(256, shape, generator=generator, dtype=torch.uint8) for _ in range(2)
    )
    action = torch.randint(ACTIONS, batch, generator=generator)
    entries = {"observation": s, "action": action, "next": {"observation": following}}
    return TensorDict(entries, batch)


def scaled(frames):
    """Bytes on the scale of [-1, 1], as the paper has states."""
    return 2 * (frames.float() / 255) - 1


def convolved(body, x):
    """Table 2's four convolutions in eval mode, from the weights of ``body``."""
    convs = [layer for layer in body if isinstance(layer, nn.Conv2d)]
    norms = [layer for layer in body if isinstance(layer, nn.BatchNorm2d)]
    assert len(convs) == len(norms) == 4
    for conv, norm in zip(convs, norms, strict=True):
        x = F.conv2d(x, conv.weight, conv.bias, stride=2)
        mean, variance, gain, shift = (
            value[:, None, None]
            for value in (norm.running_mean, norm.running_var, norm.weight, norm.bias)
        )
        x = (x - mean) / (variance + 1e-5).sqrt() * gain + shift
        x = torch.where(x > 0, x, 0.01 * x)
    return x.flatten(1)


def decoded(decoder, code, s):
    """The decoder of Table 2 from its weights."""

    def leaky(x):
        return torch.where(x > 0, x, 0.01 * x)

    full = [layer for layer in decoder.painter if isinstance(layer, nn.Linear)]
    ups = [layer for layer in decoder.painter if isinstance(layer, nn.ConvTranspose2d)]
    x = code
    for layer in full:
        x = leaky(x @ layer.weight.T + layer.bias)
    x = x.view(-1, 64, 4, 4)
    for layer in ups[:-1]:
        x = leaky(F.conv_transpose2d(x, layer.weight, layer.bias, stride=2))
    x = F.conv_transpose2d(x, ups[-1].weight, ups[-1].bias)
    last = decoder.last
    return F.conv2d(torch.cat((x, s), 1), last.weight, last.bias, padding=2, dilation=2)


def run_in(loss, data, times=3):
    """Gives batch normalisation statistics that are not those of its first hour."""
    loss.train()
    for _ in range(times):
        loss(data)
    return loss.eval()
