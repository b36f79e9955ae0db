import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule

from giril_rl.errors import UserError
from giril_rl.rewards import AffineReward, ConstantReward


def test_by_hand():
    square = TensorDictModule(torch.square, ["a"], [("next", "r")])
    reward = AffineReward(square, -2.0, 0.5)
    assert reward.in_keys == ["a"] and reward.out_keys == [("next", "r")]
    batch = reward(TensorDict({"a": torch.tensor([[1.0], [3.0]])}, [2]))
    assert batch["next", "r"].tolist() == [[-1.5], [-17.5]]
    assert batch["next", "r"].dtype == torch.float32


def test_keeps_a_double_a_double():
    double = TensorDictModule(torch.square, ["a"], ["r"])
    batch = AffineReward(double, 1, 2)(TensorDict({"a": torch.ones(2, 1).double()}, [2]))
    assert batch["r"].dtype == torch.float64


def test_numbers_are_saved():
    state = AffineReward(ConstantReward(3.0), -1.0, 0.25).state_dict()
    fresh = AffineReward(ConstantReward(3.0))
    fresh.load_state_dict(state)
    assert fresh(TensorDict(batch_size=[]))["next", "intrinsic_reward"].tolist() == [-2.75]


def test_refusals():
    with pytest.raises(UserError, match="scale=0"):
        AffineReward(ConstantReward(), 0.0)
    two = TensorDictModule(lambda a: (a, a), ["a"], ["x", "y"])
    with pytest.raises(UserError, match="writes"):
        AffineReward(two)
