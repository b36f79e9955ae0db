"""Nested states of checkpoints, compared bit for bit."""

import torch


def assert_equal(found, expected, path="", *, equal_nan=False):
    """Nested state, bit for bit; ``equal_nan`` lets NaN be equal to NaN."""
    assert type(found) is type(expected), path
    if isinstance(found, dict):
        assert found.keys() == expected.keys(), path
        for key in found:
            assert_equal(found[key], expected[key], f"{path}.{key}", equal_nan=equal_nan)
    elif isinstance(found, list):
        assert len(found) == len(expected), path
        for i, (one, other) in enumerate(zip(found, expected, strict=True)):
            assert_equal(one, other, f"{path}.{i}", equal_nan=equal_nan)
    elif isinstance(found, torch.Tensor):
        assert found.dtype == expected.dtype and found.shape == expected.shape, path
        both_nan = found.isnan() & expected.isnan() if equal_nan else False
        assert ((found == expected) | both_nan).all(), path
    else:
        assert found == expected, path
