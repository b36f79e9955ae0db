import math
import re

import pytest
import torch
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    MultiCategorical,
    OneHot,
    Unbounded,
)

from giril_rl.errors import UserError
from giril_rl.rewards import ActionEncoder


def test_discrete():
    encoder = ActionEncoder(Categorical(4, shape=(8,)))
    action = torch.tensor([[3, 0], [1, 1]])
    code = encoder(action)
    assert encoder.size == 4 and code.shape == (2, 2, 4) and code.dtype == torch.float32
    assert torch.equal(code.argmax(-1), action) and torch.equal(code.sum(-1), torch.ones(2, 2))
    assert torch.equal(encoder.target(action), action)


@pytest.mark.parametrize("dtype", [torch.bool, torch.int64])
def test_one_hot(dtype):
    encoder = ActionEncoder(OneHot(3, shape=(2, 3)))
    action = torch.tensor([[0, 1, 0], [0, 0, 1]], dtype=dtype)
    assert encoder(action).tolist() == [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    assert encoder.target(action).tolist() == [1, 2]


def test_a_nearly_one_hot_vector_is_not_class_0():
    encoder = ActionEncoder(OneHot(3))
    assert encoder.target(torch.tensor([[0.0, 0.0, 0.9999]])).tolist() == [2]


INTEGERS = torch.zeros(7, dtype=torch.int64)


@pytest.mark.parametrize(
    ("spec", "action", "needed"),
    [
        (OneHot(3), INTEGERS, r"one-hot vectors of shape \(\*batch, 3\)"),
        (OneHot(3), INTEGERS.unsqueeze(-1), r"one-hot vectors of shape \(\*batch, 3\)"),
        (OneHot(3), torch.eye(4).bool(), r"one-hot vectors of shape \(\*batch, 3\)"),
        (Categorical(3), torch.rand(7), r"integers of shape \(\*batch,\)"),
        (Bounded(-1, 1, shape=(2,)), torch.rand(7, 1), r"vectors of shape \(\*batch, 2\)"),
    ],
)
def test_another_encoding_is_refused(spec, action, needed):
    encoder = ActionEncoder(spec)
    for method in (encoder, encoder.target):
        with pytest.raises(UserError, match=needed) as refusal:
            method(action)
        assert f"{action.dtype} of shape {tuple(action.shape)}" in str(refusal.value)


@pytest.mark.parametrize(
    ("spec", "action", "index"),
    [
        (Categorical(3), torch.tensor([[0, 2], [-1, 0]]), "[1, 0]"),
        (Categorical(3), torch.tensor([2, 3]), "[1]"),
        (OneHot(3), torch.tensor([[0, 1, 0], [0, 0, 0]]), "[1]"),
        (OneHot(2), torch.tensor([[0.5, 0.5], [0.0, 1.0]]), "[0]"),
        (OneHot(2), torch.ones(1, 2, dtype=torch.bool), "[0]"),
    ],
)
def test_values_that_are_no_action(spec, action, index):
    with pytest.raises(UserError, match=rf"index {re.escape(index)} is"):
        ActionEncoder(spec).check_values(action)


def test_box_is_clamped_then_mapped_where_bounded():
    low = torch.tensor([-2.0, 0.0, -math.inf, 1.0]).expand(3, 4)
    high = torch.tensor([2.0, 10.0, math.inf, math.inf]).expand(3, 4)
    encoder = ActionEncoder(Bounded(low, high, shape=(3, 4)))
    action = torch.tensor([[1.0, 5.0, 7.0, 9.0], [-9.0, 99.0, -7.0, 0.0]])
    assert encoder(action).tolist() == [[0.5, 0.0, 7.0, 9.0], [-1.0, 1.0, -7.0, 1.0]]
    assert torch.equal(encoder.target(action), encoder(action))


def test_unbounded_is_unchanged():
    encoder = ActionEncoder(Unbounded(shape=(16, 2)))
    assert encoder.size == 2
    assert encoder(torch.tensor([1e6, -3.0])).tolist() == [1e6, -3.0]


@pytest.mark.parametrize(
    "spec",
    [
        MultiCategorical([2, 3]),
        Binary(3),
        Unbounded(shape=()),
        Bounded(0, 3, shape=(2,), dtype=torch.int64),
        Bounded(-torch.ones(2, 1), torch.tensor([[1.0], [2.0]]), shape=(2, 1)),
    ],
    ids=["multi", "binary", "scalar", "integers", "unequal"],
)
def test_unsupported(spec):
    with pytest.raises(UserError):
        ActionEncoder(spec)
