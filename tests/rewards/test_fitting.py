import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical

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


def without_next():
    return demonstration(3).exclude(("next", "observation"))


def without_batch_size():
    return TensorDict(demonstration(3).to_dict())


def with_nan(key, *index):
    demo = demonstration(2, 5)
    demo[key][index] = torch.nan
    return demo


@pytest.mark.parametrize(
    ("demo", "sentence"),
    [
        (without_next(), r"no \('next', 'observation'\): give transitions with"),
        (without_batch_size(), r"batch_size is \[\] where its observations have \[3\]"),
        (with_nan("observation", 1, 3, 0), r"observation is nan at index \[1, 3, 0\]"),
        (
            with_nan(("next", "observation"), 0, 4, 1),
            r"'observation'\) is nan at index \[0, 4, 1\]",
        ),
        (with_nan("action", 1, 0, 0), r"action is nan at index \[1, 0, 0\]"),
    ],
    ids=["no next", "no batch size", "observation", "next observation", "action"],
)
def test_a_bad_demonstration_changes_nothing(demo, sentence):
    reward = GenerativeReward.for_vectors(2, SPEC)
    before = {name: value.clone() for name, value in reward.state_dict().items()}
    with pytest.raises(UserError, match=sentence):
        fit(GenerativeRewardLoss(reward), demo, steps=1)
    assert all(torch.equal(value, before[name]) for name, value in reward.state_dict().items())


def test_actions_outside_the_spec():
    demo = demonstration(4)
    demo["action"] = torch.tensor([0, 2, 3, 1])
    loss = CuriosityRewardLoss(CuriosityReward.for_vectors(2, Categorical(3)))
    with pytest.raises(UserError, match=r"action at index \[2\] is 3"):
        fit(loss, demo, steps=1)


def test_a_loss_that_is_not_finite_is_told():
    loss = GenerativeRewardLoss(GenerativeReward.for_vectors(2, SPEC))
    with pytest.raises(UserError, match=r"after 3 steps of lr=1e\+30: give a smaller lr"):
        fit(loss, demonstration(8), steps=3, lr=1e30)
