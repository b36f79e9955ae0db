"""The losses that train on frames, each with the columns of one gradient step."""

import torch
from tensordict import TensorDict
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
