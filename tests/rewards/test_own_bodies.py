"""Rewards of a user's own networks: any modules that are called with two inputs."""

import pytest
import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded, Categorical

from giril_rl.rewards import (
    ActionEncoder,
    BottleneckLoss,
    BottleneckReward,
    CuriosityReward,
    CuriosityRewardLoss,
    DiscriminatorLoss,
    DiscriminatorReward,
    GenerativeReward,
    GenerativeRewardLoss,
    ObservationScaler,
    PixelScaler,
)
from giril_rl.transforms import IntrinsicReward


class Gate(nn.Module):
    """A body as a user may have it: residual, gated, of two inputs."""

    def __init__(self, one, two, out):
        super().__init__()
        self.first, self.second = nn.Linear(one, 16), nn.Linear(two, 16)
        self.norm, self.out = nn.LayerNorm(16), nn.Linear(16, out)

    def forward(self, one, two):
        gate = torch.sigmoid(self.second(two))
        return self.out(self.norm(gate * self.first(one)))


class Frames(nn.Module):
    """Frames of any size, and whatever stands beside them, to ``out`` numbers."""

    def __init__(self, channels, beside, out):
        super().__init__()
        self.convolution = nn.Conv2d(channels, 4, 3, stride=2)
        self.out = nn.LazyLinear(out) if beside is None else nn.Linear(4 + beside, out)

    def forward(self, frames, beside=None):
        flat = frames.reshape(-1, *frames.shape[-3:])
        code = self.convolution(flat).mean((-1, -2)).reshape(*frames.shape[:-3], 4)
        return self.out(code if beside is None else torch.cat((code, beside), -1))


class Painter(nn.Module):
    """A frame as the mean colour that an action's code asks for."""

    def __init__(self, actions, channels):
        super().__init__()
        self.colour = nn.Linear(actions, channels)

    def forward(self, code, frames):
        return frames + self.colour(code)[..., None, None]


class Pair(nn.Module):
    def __init__(self, out):
        super().__init__()
        self.one, self.two = Frames(2, None, out), Frames(2, None, out)

    def forward(self, observation, following):
        return self.one(observation) + self.two(following)


BOX, DISCRETE = ActionEncoder(Bounded(-1, 1, shape=(2,))), ActionEncoder(Categorical(3))


def generative():
    bodies = Gate(5, 5, 4), Gate(2, 5, 5)
    return GenerativeReward(*bodies, scaler=ObservationScaler(5, rule="raw"), actions=BOX)


def curious():
    bodies = nn.Linear(5, 7), Gate(7, 7, 2), Gate(7, 2, 7)
    return CuriosityReward(*bodies, scaler=ObservationScaler(5, rule="raw"), actions=BOX)


def discriminator():
    scaler = ObservationScaler(5, rule="raw")
    return DiscriminatorReward(Gate(5, 2, 1), scaler=scaler, actions=BOX)


def bottleneck():
    scaler = ObservationScaler(5, rule="raw")
    return BottleneckReward(Gate(5, 2, 6), nn.Linear(3, 1), scaler=scaler, actions=BOX)


def generative_of_frames():
    scaler = PixelScaler()
    return GenerativeReward(Pair(6), Painter(3, 2), scaler=scaler, actions=DISCRETE)


def discriminator_of_frames():
    return DiscriminatorReward(Frames(2, 3, 1), scaler=PixelScaler(), actions=DISCRETE)


def transitions(*shape, frames):
    if frames:
        pair = torch.randint(256, (2, *shape, 2, 10, 8), dtype=torch.uint8)
        action = torch.randint(3, shape)
    else:
        pair, action = torch.randn(2, *shape, 5), torch.rand(*shape, 2)
    following = {"observation": pair[1], "reward": torch.zeros(*shape, 1)}
    return TensorDict({"observation": pair[0], "action": action, "next": following}, shape)


CASES = [
    (generative, GenerativeRewardLoss),
    (curious, CuriosityRewardLoss),
    (discriminator, DiscriminatorLoss),
    (bottleneck, BottleneckLoss),
    (generative_of_frames, GenerativeRewardLoss),
    (discriminator_of_frames, DiscriminatorLoss),
]


@pytest.mark.parametrize(("make", "loss_class"), CASES)
def test_reward_relabels_and_trains(make, loss_class):
    torch.manual_seed(0)
    frames = make in (generative_of_frames, discriminator_of_frames)
    reward = make()
    for shape in [(), (4,), (2, 3), (2, 2, 3)]:
        batch = IntrinsicReward(reward)(transitions(*shape, frames=frames))
        assert batch["next", "reward"].shape == (*shape, 1)
    loss = loss_class(reward)
    batch = transitions(16, frames=frames)
    if loss_class in (DiscriminatorLoss, BottleneckLoss):
        batch = TensorDict({"expert": batch[:6], "policy": batch[6:]})
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-3)
    values = []
    for _ in range(60):
        out = loss(batch)
        value = sum(out[key] for key in out.keys() if key.startswith("loss_"))
        optimizer.zero_grad()
        value.backward()
        optimizer.step()
        values.append(value.item())
    assert sum(values[-5:]) < sum(values[:5])
    moved = [p.grad is not None and p.grad.abs().sum() > 0 for p in loss.parameters()]
    assert all(moved)


def test_rewards_are_those_of_the_formula():
    reward, batch = generative(), transitions(4, frames=False)
    s, a, following = batch["observation"], batch["action"], batch["next", "observation"]
    clamped = s.clamp(-1, 1), following.clamp(-1, 1)
    predicted = reward.decoder(a, clamped[0]).clamp(-1, 1)
    expected = F.mse_loss(predicted, clamped[1], reduction="none").sum(-1, keepdim=True)
    out = IntrinsicReward(reward)(batch)["next", "reward"]
    torch.testing.assert_close(out, expected.detach())
