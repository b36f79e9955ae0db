"""Losses in TorchRL's way: parameters apart, plain tensors, many parameters at once."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictParams
from torchrl.data import Bounded

from giril_rl.rewards import (
    BottleneckLoss,
    BottleneckReward,
    CuriosityReward,
    CuriosityRewardLoss,
    DiscriminatorLoss,
    DiscriminatorReward,
    GenerativeReward,
    GenerativeRewardLoss,
)

CASES = [
    (GenerativeReward, GenerativeRewardLoss),
    (CuriosityReward, CuriosityRewardLoss),
    (DiscriminatorReward, DiscriminatorLoss),
    (BottleneckReward, BottleneckLoss),
]
ADVERSARIAL = (DiscriminatorLoss, BottleneckLoss)


def make(cls, seed=0):
    reward = cls.for_vectors(3, Bounded(-1, 1, shape=(1,)), hidden=(8,), seed=seed)
    reward.scaler.fit(torch.tensor([[0.0, 1.0, -1.0], [2.0, 4.0, 1.0]]))
    return reward


def make_batch(loss_class):
    generator = torch.Generator().manual_seed(0)
    s, following = torch.randn(2, 8, 3, generator=generator)
    action = torch.rand(8, 1, generator=generator)
    batch = TensorDict(
        {"observation": s, "action": action, "next": {"observation": following}}, [8]
    )
    if loss_class in ADVERSARIAL:
        return TensorDict({"expert": batch[:3], "policy": batch[3:]})
    return batch


def total(out):
    return sum(value for key, value in out.items() if key.startswith("loss_"))


@pytest.mark.parametrize(("cls", "loss_class"), CASES)
def test_functional_is_the_same_loss(cls, loss_class):
    reward = make(cls)
    plain, functional = loss_class(reward), loss_class(make(cls), functional=True)
    assert not plain.functional and functional.functional
    assert isinstance(functional.reward_params, TensorDictParams)
    assert any(name.startswith("reward.") for name in plain.state_dict())
    assert all(not name.startswith("reward.") for name in functional.state_dict())
    outs = []
    for loss in (plain, functional):
        torch.manual_seed(0)
        outs.append(loss(make_batch(loss_class)))
        total(outs[-1]).backward()
    assert (outs[0] == outs[1]).all()
    gradients = [
        sorted(p.grad.abs().sum().item() for p in x.parameters()) for x in (plain, functional)
    ]
    assert gradients[0] == gradients[1] and sum(gradients[0]) > 0
    # The trained weights go back into a module, and other ones into the loss.
    net = functional.get_stateful_net("reward")
    assert type(net) is cls
    functional.from_stateful_net("reward", make(cls, seed=1))
    torch.manual_seed(0)
    again = functional(make_batch(loss_class))
    torch.manual_seed(0)
    assert (again == loss_class(make(cls, seed=1))(make_batch(loss_class))).all()
    assert all(p.dtype == torch.float64 for p in functional.to(torch.float64).parameters())


@pytest.mark.parametrize(("cls", "loss_class"), CASES)
@pytest.mark.parametrize("functional", [False, True])
def test_vmap_over_parameters(cls, loss_class, functional):
    rewards = [make(cls, seed) for seed in range(3)]
    stacked = TensorDict.from_modules(*rewards)
    loss, batch = loss_class(make(cls), functional=functional), make_batch(loss_class)
    holder = loss.reward_params if functional else loss.reward

    def value(parameters):
        with parameters.to_module(holder):
            return total(loss(batch))

    torch.manual_seed(0)
    values = torch.vmap(value, randomness="same")(stacked)
    assert values.shape == (3,)
    for reward, found in zip(rewards, values, strict=True):
        torch.manual_seed(0)
        torch.testing.assert_close(total(loss_class(reward)(batch)), found)
    values.sum().backward()
    gradients = [stacked.get(key).grad for key in stacked.keys(True, True)]
    assert any(g is not None and (g.flatten(1).abs().sum(1) > 0).all() for g in gradients)


@pytest.mark.parametrize("functional", [False, True])
@pytest.mark.parametrize(("cls", "loss_class"), CASES)
def test_plain_tensors_by_keyword(cls, loss_class, functional):
    loss, batch = loss_class(make(cls), functional=functional), make_batch(loss_class)
    torch.manual_seed(0)
    expected = loss(batch)
    tensors = {"_".join(key) if isinstance(key, tuple) else key: batch[key] for key in loss.in_keys}
    torch.manual_seed(0)
    out = loss(**tensors)
    assert len(out) == len(loss.out_keys)
    for key, value in zip(loss.out_keys, out, strict=True):
        assert torch.equal(value, expected[key])
