"""Each wrong reward is refused for what is wrong with it; right ones of all kinds are not."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded

from giril_rl import check_reward
from giril_rl.errors import UserError
from giril_rl.rewards import (
    ConstantReward,
    CuriosityReward,
    DiscriminatorReward,
    GenerativeReward,
    NoiseReward,
)

SPEC = Bounded(-1.0, 1.0, shape=(1,))


@pytest.fixture
def batch():
    generator = torch.Generator().manual_seed(0)

    def draw(size):
        return torch.rand(4, 5, size, generator=generator) - 0.5

    after = TensorDict({"observation": draw(2)}, [4, 5])
    return TensorDict({"observation": draw(2), "action": draw(1), "next": after}, [4, 5])


def of(function):
    return TensorDictModule(function, ["observation"], [("next", "intrinsic_reward")])


@pytest.mark.parametrize("kind", [GenerativeReward, CuriosityReward, DiscriminatorReward])
def test_learned_rewards_pass(kind, batch):
    reward = kind.for_vectors(2, SPEC)
    reward.scaler.fit(batch["observation"])
    before = batch.clone()
    check_reward(reward, batch)
    assert (batch == before).all()


def test_a_constant_and_noise_pass(batch):
    check_reward(ConstantReward(1.0), batch)
    noise = NoiseReward(1.0, 0.5)
    check_reward(noise, batch, deterministic=False)
    with pytest.raises(UserError, match="changes the module's"):
        check_reward(noise, batch)


class Counting(nn.Module):
    def __init__(self):
        super().__init__()
        self.register_buffer("seen", torch.zeros(()))

    def forward(self, observation):
        self.seen += 1
        return observation[..., :1]


class Hidden(nn.Module):
    calls = 0

    def forward(self, observation):
        self.calls += 1
        return observation[..., :1] + self.calls


WRONG = {
    "shape": (lambda s: s.sum(-1), "shape"),
    "whole numbers": (lambda s: (s[..., :1] > 0).long(), "int64"),
    "infinite": (lambda s: s[..., :1] / 0, "infinite"),
    "mean of the batch": (lambda s: s[..., :1] - s.mean(), "depends on the others"),
    "order": (lambda s: s[..., :1].cumsum(0), "depends on the others"),
    "dimensions": (lambda s: s[..., :1] * s.ndim, r"\(2, n\)"),
    "global noise": (lambda s: torch.rand(*s.shape[:-1], 1), "global generator"),
    "changes the batch": (lambda s: s.add_(1)[..., :1], "changes 'observation'"),
    "statistics": (Counting(), "'module.seen'"),
    "hidden state": (Hidden(), "the second time"),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_reward_is_refused(name, batch):
    function, message = WRONG[name]
    with pytest.raises(UserError, match=message):
        check_reward(of(function), batch)


def test_a_reward_that_reads_the_environments_is_held_to_the_same(batch):
    batch["next", "reward"] = torch.arange(20.0).reshape(4, 5, 1)
    keys = [("next", "reward")], [("next", "intrinsic_reward")]
    check_reward(TensorDictModule(lambda r: 2 * r, *keys), batch)
    with pytest.raises(UserError, match="int64"):
        check_reward(TensorDictModule(lambda r: r.long(), *keys), batch)


def test_too_few_transitions_are_refused(batch):
    with pytest.raises(UserError, match="at least 3"):
        check_reward(ConstantReward(1.0), batch[0, :2])
