"""On frames a convolution's gradient may lie in memory otherwise than its weights do.

torch's fused Adam reads both as the weights lie, without a word: each weight would take the step of
another one.
"""

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Categorical

from giril_rl.configs import PPOConfig
from giril_rl.networks.pixel_policy import PixelActorCritic
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
from giril_rl.training.ppo import PPOLearner
from giril_rl.training.traced import TracedGradients

ROWS = 8


def frames():
    return torch.randint(256, (ROWS, 4, 84, 84), dtype=torch.uint8)


def fitted(reward_cls, loss_cls):
    loss = loss_cls(reward_cls.for_pixels(Categorical(4), seed=0)).train()
    data = {"observation": frames(), "action": torch.randint(4, (ROWS,))}
    batch = TensorDict({**data, "next": {"observation": frames()}}, [ROWS])
    return TracedGradients(loss, keys=loss.in_keys), [batch.get(key) for key in loss.in_keys]


def discriminated(reward_cls, loss_cls, penalty=0.0):
    loss = loss_cls(reward_cls.for_pixels(Categorical(4), seed=0), penalty=penalty).train()
    pairs = [x for _ in range(2) for x in (frames(), torch.randint(4, (ROWS,)))]
    return TracedGradients(loss, keys=loss.in_keys), pairs


def ppo():
    agent = PixelActorCritic(4)
    learner = PPOLearner(agent, PPOConfig(clip_value=True, entropy_coef=0.01), total_steps=8)
    rows = {
        "action": torch.randint(4, (ROWS,)),
        agent.input_keys[0]: agent.actor.deal(frames()),
        "action_log_prob": torch.full((ROWS,), -1.4),
        **{key: torch.randn(ROWS, 1) for key in ("advantage", "value_target", "state_value")},
    }
    return learner.gradients, [rows[key] for key in learner.keys]


CASES = {
    "ppo": ppo,
    "giril": lambda: fitted(GenerativeReward, GenerativeRewardLoss),
    "cdil": lambda: fitted(CuriosityReward, CuriosityRewardLoss),
    "gail": lambda: discriminated(DiscriminatorReward, DiscriminatorLoss),
    "gail with a penalty": lambda: discriminated(DiscriminatorReward, DiscriminatorLoss, 10.0),
    "vail": lambda: discriminated(BottleneckReward, BottleneckLoss),
}


@pytest.mark.parametrize("name", CASES)
def test_every_weight_takes_its_own_step(name):
    torch.manual_seed(0)
    gradients, inputs = CASES[name]()
    parameters = gradients.parameters
    twins = [nn.Parameter(p.detach().clone()) for p in parameters]
    gradients.step(inputs)
    for twin, parameter in zip(twins, parameters, strict=True):
        assert parameter.grad.stride() == parameter.stride()
        twin.grad = parameter.grad.clone()
    torch.optim.Adam(twins, lr=1e-3, fused=False, foreach=False).step()
    torch.optim.Adam(parameters, lr=1e-3, fused=True).step()
    for twin, parameter in zip(twins, parameters, strict=True):
        torch.testing.assert_close(parameter, twin, rtol=1e-5, atol=1e-7)


def test_a_gradient_with_channels_last_keeps_its_values():
    class Last(nn.Module):
        def __init__(self):
            super().__init__()
            self.weight = nn.Parameter(torch.randn(3, 2, 3, 3))

        def forward(self, batch):
            last = self.weight.contiguous(memory_format=torch.channels_last)
            convolved = nn.functional.conv2d(batch["x"], last)
            return TensorDict({"loss_a": convolved.square().sum()})

    module = Last()
    x = torch.randn(4, 2, 7, 7).contiguous(memory_format=torch.channels_last)
    (expected,) = torch.autograd.grad(module(TensorDict({"x": x}))["loss_a"], [module.weight])
    traced = TracedGradients(module, keys=["x"])
    traced._recorded = False  # As for a module of convolution layers.
    traced.step([x])
    assert module.weight.grad.is_contiguous()
    torch.testing.assert_close(module.weight.grad, expected)
