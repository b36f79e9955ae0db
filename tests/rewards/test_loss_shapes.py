"""A loss is the same for transitions of any leading shape."""

import copy
import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, OneHot

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
from giril_rl.rewards.adversarial import gradient_penalty

SPECS = {"box": Bounded(-1, 1, shape=(2,)), "discrete": Categorical(4), "one_hot": OneHot(4)}
SHAPES = [(), (1,), (4, 5), (2, 3, 2)]


def transitions(spec, *shape, frames=False):
    if frames:
        s, following = torch.randint(256, (2, *shape, 4, 84, 84), dtype=torch.uint8)
    else:
        s, following = torch.randn(2, *shape, 3)
    action = spec.expand(*shape, *spec.shape).rand()
    entries = {"observation": s, "action": action, "next": {"observation": following}}
    return TensorDict(entries, shape)


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
@pytest.mark.parametrize("policy", [(3, 5), (7,)])
def test_of_two_sets(kind, expert, policy):
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
        sum(out[key] for key in out.keys() if key.startswith("loss_")).backward()
        assert any(p.grad is not None and p.grad.abs().sum() > 0 for p in loss.parameters())


@pytest.mark.parametrize("shape", [(), (6,), (2, 3), (2, 1, 3)])
def test_the_gradient_penalty_by_hand(shape):
    """The slope is (3 s, 4) at s, and s is 0 or 1: norms of 4 and 5."""
    s = torch.arange(math.prod(shape)).reshape(*shape, 1) % 2.0
    expected = torch.where(s == 0, 9.0, 16.0).mean()
    points = s, torch.zeros(*shape, 1)
    found = gradient_penalty(lambda s, a: (1.5 * s.square() + 4 * a).sum(-1), points)
    torch.testing.assert_close(found, expected)
