"""Random observations with actions."""

import torch
from tensordict import TensorDict


def pairs(*shape, kind="box", shift=0.0, dim=3, seed=0):
    generator = torch.Generator().manual_seed(seed)
    observation = torch.randn(*shape, dim, generator=generator) + shift
    if kind == "discrete":
        action = torch.randint(2, shape, generator=generator)
    else:
        action = 2 * torch.rand(*shape, 1, generator=generator) - 1
    return TensorDict({"observation": observation, "action": action}, shape)
