"""Random observations with actions, and nested states compared bit for bit."""

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


def assert_equal(found, expected, path=""):
    """Nested state, bit for bit."""
    assert type(found) is type(expected), path
    if isinstance(found, dict):
        assert found.keys() == expected.keys(), path
        for key in found:
            assert_equal(found[key], expected[key], f"{path}.{key}")
    elif isinstance(found, list):
        assert len(found) == len(expected), path
        for i, (one, other) in enumerate(zip(found, expected, strict=True)):
            assert_equal(one, other, f"{path}.{i}")
    elif isinstance(found, torch.Tensor):
        assert found.dtype == expected.dtype and torch.equal(found, expected), path
    else:
        assert found == expected, path
