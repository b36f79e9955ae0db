import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded

from giril_rl.errors import UserError
from giril_rl.rewards import (
    CuriosityReward,
    CuriosityRewardLoss,
    DiscriminatorLoss,
    DiscriminatorReward,
    GenerativeReward,
    GenerativeRewardLoss,
    fit,
)

SPEC = Bounded(-1, 1, shape=(1,))


def demonstration(*shape):
    s, a = torch.randn(*shape, 2), torch.rand(*shape, 1)
    following = {"observation": 0.9 * s + 0.1 * a}
    return TensorDict({"observation": s, "action": a, "next": following}, shape)


@pytest.mark.parametrize(
    ("cls", "loss_class"),
    [(GenerativeReward, GenerativeRewardLoss), (CuriosityReward, CuriosityRewardLoss)],
)
@pytest.mark.parametrize("functional", [False, True])
def test_learns_and_leaves_no_trace(cls, loss_class, functional):
    reward, demo = cls.for_vectors(2, SPEC, hidden=(16,)), demonstration(4, 25)
    before = demo.clone()
    state = torch.get_rng_state()
    loss = loss_class(reward, functional=functional)
    few = fit(loss, demo, steps=2, lr=1e-3)
    many = fit(loss, demo, steps=200, lr=3e-3)
    assert sum(many.values()) < sum(few.values())
    assert (demo == before).all() and torch.equal(torch.get_rng_state(), state)
    twin = loss_class(cls.for_vectors(2, SPEC, hidden=(16,)), functional=functional)
    fit(twin, demo, steps=2, lr=1e-3)
    assert fit(twin, demo, steps=200, lr=3e-3) == many


def test_bad_inputs():
    loss = GenerativeRewardLoss(GenerativeReward.for_vectors(2, SPEC))
    with pytest.raises(UserError, match="0 transitions"):
        fit(loss, demonstration(0))
    with pytest.raises(UserError, match="steps=0"):
        fit(loss, demonstration(3), steps=0)
    with pytest.raises(UserError, match="beside the policy"):
        fit(DiscriminatorLoss(DiscriminatorReward.for_vectors(2, SPEC)), demonstration(3))
