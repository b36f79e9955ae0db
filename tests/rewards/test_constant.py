import torch
from tensordict import TensorDict

from giril_rl.rewards import ConstantReward


def test_shape_value_and_key():
    batch = ConstantReward()(TensorDict(batch_size=[3, 5]))
    assert torch.equal(batch["next", "intrinsic_reward"], torch.ones(3, 5, 1))
    batch = ConstantReward(-2.0, out_keys=(("a", "b"),))(TensorDict(batch_size=[]))
    assert batch["a", "b"].tolist() == [-2.0]
