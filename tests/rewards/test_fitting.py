"""Fitting in one call, and what all losses hold: TorchRL's ways, and batches of any shape."""

import copy

import pytest
import torch
from reward_data import SPECS, total, transition
from tensordict import TensorDict
from tensordict.nn import TensorDictParams
from torchrl.data import Bounded, Categorical

from giril_rl.errors import UserError
from giril_rl.rewards import (
    BottleneckLoss,
    BottleneckReward,
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
    return transition(s, a, 0.9 * s + 0.1 * a, shape)


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


# TorchRL's ways: parameters apart, plain tensors, many parameters at once.

CASES = [
    (GenerativeReward, GenerativeRewardLoss),
    (CuriosityReward, CuriosityRewardLoss),
    (DiscriminatorReward, DiscriminatorLoss),
    (BottleneckReward, BottleneckLoss),
]
ADVERSARIAL = (DiscriminatorLoss, BottleneckLoss)


def make(cls, seed=0):
    reward = cls.for_vectors(3, SPEC, hidden=(8,), seed=seed)
    reward.scaler.fit(torch.tensor([[0.0, 1.0, -1.0], [2.0, 4.0, 1.0]]))
    return reward


def make_batch(loss_class):
    generator = torch.Generator().manual_seed(0)
    s, s_next = torch.randn(2, 8, 3, generator=generator)
    batch = transition(s, torch.rand(8, 1, generator=generator), s_next)
    if loss_class in ADVERSARIAL:
        return TensorDict({"expert": batch[:3], "policy": batch[3:]})
    return batch


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


@pytest.mark.parametrize(("cls", "loss_class"), CASES[:2])
def test_reductions(cls, loss_class):
    values = {}
    for reduction in ("none", "mean", "sum"):
        torch.manual_seed(0)
        values[reduction] = loss_class(make(cls), reduction=reduction)(make_batch(loss_class))
    for key, term in values["none"].items():
        assert term.shape == (8,)
        torch.testing.assert_close(values["mean"][key], term.mean())
        torch.testing.assert_close(values["sum"][key], term.sum())


@pytest.mark.parametrize(("cls", "loss_class"), CASES)
def test_copies_and_saved_states_are_the_same_loss(cls, loss_class):
    loss, other, batch = (
        loss_class(make(cls)),
        loss_class(make(cls, seed=5)),
        make_batch(loss_class),
    )
    other.load_state_dict(loss.state_dict())
    outs = []
    for each in (loss, copy.deepcopy(loss), other):
        torch.manual_seed(0)
        outs.append(each(batch))
    assert (outs[0] == outs[1]).all() and (outs[0] == outs[2]).all()


# A loss is the same for transitions of any leading shape.

SHAPES = [(), (4, 5), (2, 3, 2)]


def transitions(spec, *shape, frames=False):
    if frames:
        s, s_next = torch.randint(256, (2, *shape, 4, 84, 84), dtype=torch.uint8)
    else:
        s, s_next = torch.randn(2, *shape, 3)
    return transition(s, spec.expand(*shape, *spec.shape).rand(), s_next, shape)


def same(loss, shaped, flat):
    torch.manual_seed(1)
    found = copy.deepcopy(loss)(shaped)  # Batch normalisation counts each call.
    torch.manual_seed(1)
    for name, value in loss(flat).items():
        torch.testing.assert_close(found[name], value, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("kind", SPECS)
@pytest.mark.parametrize("shape", SHAPES)
def test_of_a_demonstration(kind, shape):
    batch = transitions(SPECS[kind], *shape)
    losses = [
        GenerativeRewardLoss(
            GenerativeReward.for_vectors(3, SPECS[kind], normalise="raw", prior="conditional")
        ),
        CuriosityRewardLoss(CuriosityReward.for_vectors(3, SPECS[kind], normalise="raw")),
    ]
    for loss in losses:
        same(loss, batch, batch.reshape(-1))
        loss.reduction = "none"
        assert all(term.shape == shape for term in loss(batch).values())


@pytest.mark.parametrize("kind", SPECS)
@pytest.mark.parametrize("expert", SHAPES)
def test_of_two_sets(kind, expert, policy=(3, 5)):
    spec = SPECS[kind]
    sets = {"expert": transitions(spec, *expert), "policy": transitions(spec, *policy)}
    shaped = TensorDict(dict(sets))
    flat = TensorDict({name: batch.reshape(-1) for name, batch in sets.items()})
    kwargs = {"normalise": "raw", "hidden": [16], "clamp": None}
    reward = DiscriminatorReward.for_vectors(3, spec, **kwargs)
    same(DiscriminatorLoss(reward, penalty=10.0), shaped, flat)
    reward = BottleneckReward.for_vectors(3, spec, **kwargs)
    same(BottleneckLoss(reward, penalty=10.0, beta=2.0), shaped, flat)


@pytest.mark.parametrize("kind", SPECS)
def test_of_frames_whatever_the_actions(kind):
    spec = SPECS[kind]
    batch = transitions(spec, 2, 2, frames=True)
    sets = TensorDict({"expert": batch, "policy": batch[:1]})
    flat = TensorDict({"expert": batch.reshape(-1), "policy": batch[:1].reshape(-1)})
    cases = [
        (GenerativeRewardLoss(GenerativeReward.for_pixels(spec)), batch, batch.reshape(-1)),
        (CuriosityRewardLoss(CuriosityReward.for_pixels(spec)), batch, batch.reshape(-1)),
        (DiscriminatorLoss(DiscriminatorReward.for_pixels(spec), penalty=1.0), sets, flat),
        (BottleneckLoss(BottleneckReward.for_pixels(spec), penalty=1.0), sets, flat),
    ]
    for loss, shaped, plain in cases:
        same(loss, shaped, plain)
        with torch.no_grad():
            paid = loss.reward.eval()(batch.clone())["next", "intrinsic_reward"]
        assert paid.shape == (2, 2, 1) and paid.isfinite().all()
        out = loss(shaped)
        total(out).backward()
        assert any(p.grad is not None and p.grad.abs().sum() > 0 for p in loss.parameters())
