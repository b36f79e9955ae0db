"""What rewards read: entries of a wrong shape are refused, and many are taken some at a time."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded, Categorical, OneHot, TensorSpec

from giril_rl.errors import UserError
from giril_rl.rewards import (
    ActionEncoder,
    BottleneckLoss,
    BottleneckReward,
    CopyReward,
    CuriosityReward,
    CuriosityRewardLoss,
    DiscriminatorLoss,
    DiscriminatorReward,
    GenerativeReward,
    GenerativeRewardLoss,
    ObservationScaler,
)
from giril_rl.rewards import transitions as transitions_module
from giril_rl.rewards.transitions import per_transition

BOX = Bounded(-1, 1, shape=(2,))
INTEGERS = torch.tensor([0, 2, 1])
LOSSES = {
    GenerativeReward: GenerativeRewardLoss,
    CuriosityReward: CuriosityRewardLoss,
    DiscriminatorReward: DiscriminatorLoss,
    BottleneckReward: BottleneckLoss,
}


def make(cls, spec: TensorSpec = BOX, rule="raw"):
    return cls.for_vectors(3, spec, hidden=[8], normalise=rule)


REWARDS = [lambda cls=cls: make(cls) for cls in LOSSES]
REWARDS += [
    lambda: make(DiscriminatorReward, rule="running"),
    lambda: make(BottleneckReward, rule="running"),
    lambda: CopyReward(ObservationScaler(3, rule="raw")),
]
NAMES = [*(cls.__name__ for cls in LOSSES), "running GAIL", "running VAIL", "CopyReward"]


def transitions(action=None):
    s, following = torch.randn(2, 3, 3)
    action = torch.rand(3, 2) if action is None else action
    return TensorDict({"observation": s, "action": action, "next": {"observation": following}}, [3])


def uses(reward, batch):
    """All that reads the batch: the reward, and its loss if it has one."""
    given = batch.clone()
    calls = [lambda: reward(given)]
    kind = LOSSES.get(type(reward))
    if kind is not None:
        if issubclass(kind, DiscriminatorLoss):
            batch = TensorDict({"expert": batch, "policy": batch}, [3])
        calls.append(lambda: kind(reward)(batch))
    return calls


def refused(reward, batch, match):
    for use in uses(reward, batch):
        with pytest.raises(UserError, match=match):
            use()


@pytest.mark.parametrize("build", REWARDS, ids=NAMES)
def test_observations_of_another_size(build):
    batch = transitions()
    for key in ("observation", ("next", "observation")):
        batch[key] = batch[key][:, :1]
    refused(build(), batch, r"shape \(3, 1\) where \(\*batch, 3\)")


@pytest.mark.parametrize("build", REWARDS, ids=NAMES)
def test_a_missing_entry(build):
    reward = build()
    for key in reward.in_keys:
        refused(reward, transitions().exclude(key), "give transitions with")


@pytest.mark.parametrize("build", REWARDS, ids=NAMES)
def test_float64_is_converted(build):
    reward, batch = build(), transitions()
    for use, expected in zip(uses(reward, batch.double()), uses(reward, batch), strict=True):
        torch.manual_seed(0)
        found = use()
        torch.manual_seed(0)
        for key, value in expected().items(True, True):
            if key not in batch.keys(True):
                assert torch.equal(found[key], value), key


@pytest.mark.parametrize("build", [*REWARDS[:2], REWARDS[-1]], ids=["GIRIL", "ICM", "copy"])
def test_a_next_observation_of_another_shape(build):
    batch = transitions()
    batch["next", "observation"] = batch["next", "observation"][:, :1]
    refused(build(), batch, r"next observations have shape \(3, 1\)")


@pytest.mark.parametrize("cls", LOSSES)
@pytest.mark.parametrize(
    ("spec", "action"),
    [
        (OneHot(3), INTEGERS),  # Three of them, as many as a one-hot vector has numbers.
        (OneHot(3), INTEGERS.unsqueeze(-1)),
        (OneHot(3), torch.eye(4)[INTEGERS].bool()),
        (Categorical(3), torch.eye(3)[INTEGERS].bool()),
        (Categorical(3), INTEGERS.unsqueeze(-1)),
        (Categorical(3), INTEGERS.float()),
        (BOX, torch.rand(3)),
        (BOX, torch.rand(3, 1)),
        (BOX, torch.rand(3, 1, 2)),
    ],
)
def test_actions_of_another_encoding(cls, spec, action):
    refused(make(cls, spec), transitions(action), "build it with these actions' own spec")


@pytest.mark.parametrize("wrong", ["decoder", "forward", "discriminator", "head"])
def test_a_network_of_another_width(wrong):
    class Wide(nn.Module):
        """Gives one number where more are needed, and two where one is."""

        def forward(self, first, *more):
            return first[..., :1] if wrong in ("decoder", "forward") else first[..., :2]

    reward = {
        "decoder": make(GenerativeReward),
        "forward": make(CuriosityReward),
        "discriminator": make(DiscriminatorReward),
        "head": make(BottleneckReward),
    }[wrong]
    name = {"forward": "forward_model", "discriminator": "network"}.get(wrong, wrong)
    setattr(reward, name, Wide())
    refused(reward, transitions(), r"gives shape \(\d, \d\) where \(\d, \d\) is needed")


def test_an_empty_set_of_pairs():
    batch = TensorDict({"expert": transitions()[:0], "policy": transitions()})
    with pytest.raises(UserError, match="the expert's set has no pairs"):
        DiscriminatorLoss(make(DiscriminatorReward))(batch)


def test_a_scaler_of_ones_own_says_nothing_of_shapes():
    """Such as one that adds what the observation lacks."""
    reward = DiscriminatorReward(
        nn.Bilinear(5, 2, 1), scaler=nn.Linear(9, 5), actions=ActionEncoder(BOX)
    )
    batch = TensorDict({"observation": torch.randn(3, 9), "action": torch.rand(3, 2)}, [3])
    assert reward(batch)["next", "intrinsic_reward"].shape == (3, 1)


class Weighted:
    """``sum(x) * y`` of each element, and the leading shapes that it was called with."""

    def __init__(self):
        self.shapes = []

    def __call__(self, x, y):
        self.shapes.append(tuple(y.shape))
        return x.sum((-3, -2, -1)) * y


def data(*batch):
    x = torch.arange(6.0 * torch.Size(batch).numel()).reshape(*batch, 1, 2, 3)
    return x, torch.randn(batch)


@pytest.mark.parametrize(
    ("batch", "shapes"),
    [
        ((4,), [(4,)]),
        ((9,), [(4,), (4,), (1,)]),
        ((2, 2), [(2, 2)]),
        ((2, 3), [(4,), (2,)]),
        ((2, 2, 2), [(4,), (4,)]),
        ((), [()]),
        ((0,), [(0,)]),
    ],
)
def test_frames_are_taken_some_at_a_time(batch, shapes, monkeypatch):
    monkeypatch.setattr(transitions_module, "PIXELS_AT_ONCE", 4)
    function, (x, y) = Weighted(), data(*batch)
    out = per_transition(function, (x, y), event_dims=3)
    assert function.shapes == shapes
    assert out.shape == batch
    assert torch.equal(out, x.sum((-3, -2, -1)) * y)


def test_vectors_are_taken_at_once(monkeypatch):
    monkeypatch.setattr(transitions_module, "PIXELS_AT_ONCE", 4)
    sizes = []
    per_transition(lambda x: sizes.append(len(x)) or x.sum(-1), (torch.ones(9, 3),), event_dims=1)
    assert sizes == [9]


def test_gradients_pass_and_inputs_need_not_be_contiguous(monkeypatch):
    monkeypatch.setattr(transitions_module, "PIXELS_AT_ONCE", 4)
    x, y = data(3, 2)
    x, y = x.transpose(0, 1), y.T.requires_grad_()
    out = per_transition(Weighted(), (x, y), event_dims=3)
    assert torch.equal(out, x.sum((-3, -2, -1)) * y)
    out.sum().backward()
    assert torch.equal(y.grad, x.sum((-3, -2, -1)))
