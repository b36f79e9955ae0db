"""The losses that train on frames, each with the columns of one gradient step."""

from functools import partial

import torch
from tensordict import TensorDict
from torchrl.data import Categorical

from giril_rl.config.schema import PPOConfig
from giril_rl.graphs import TracedGradients
from giril_rl.policies import PixelActorCritic
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
from giril_rl.training.ppo import PPO


def frames(rows):
    return torch.randint(256, (rows, 4, 84, 84), dtype=torch.uint8)


def fitted(reward_cls, loss_cls, rows):
    loss = loss_cls(reward_cls.for_pixels(Categorical(4), seed=0)).train()
    data = {"observation": frames(rows), "action": torch.randint(4, (rows,))}
    batch = TensorDict({**data, "next": {"observation": frames(rows)}}, [rows])
    return TracedGradients(loss, keys=loss.in_keys), [batch.get(key) for key in loss.in_keys]


def discriminated(reward_cls, loss_cls, rows, penalty=0.0):
    loss = loss_cls(reward_cls.for_pixels(Categorical(4), seed=0), penalty=penalty).train()
    pairs = [x for _ in range(2) for x in (frames(rows), torch.randint(4, (rows,)))]
    return TracedGradients(loss, keys=loss.in_keys), pairs


def ppo(rows):
    agent = PixelActorCritic(4)
    learner = PPO(agent, PPOConfig(clip_value=True, entropy_coef=0.01), steps=8)
    rows = {
        "action": torch.randint(4, (rows,)),
        agent.input_keys[0]: agent.actor.deal(frames(rows)),
        "action_log_prob": torch.full((rows,), -1.4),
        **{key: torch.randn(rows, 1) for key in ("advantage", "value_target", "state_value")},
    }
    return learner.gradients, [rows[key] for key in learner.keys]


CASES = {
    "ppo": ppo,
    "giril": partial(fitted, GenerativeReward, GenerativeRewardLoss),
    "cdil": partial(fitted, CuriosityReward, CuriosityRewardLoss),
    "gail": partial(discriminated, DiscriminatorReward, DiscriminatorLoss),
    "gail with a penalty": partial(
        discriminated, DiscriminatorReward, DiscriminatorLoss, penalty=10.0
    ),
    "vail": partial(discriminated, BottleneckReward, BottleneckLoss),
}
"""For a number of transitions, a loss's gradients and the columns of one step."""
