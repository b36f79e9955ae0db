"""TorchRL's PPO on a Gymnasium task, to which GIRIL's reward is added by five lines.

Everything but the five lines marked with ``# GIRIL`` is plain TorchRL. The policy gets the reward
of a model that is fitted to a demonstration: transitions (observation, action, next observation)
in a folder written by TensorDict.save(), or, without one, what a heuristic for Pendulum-v1 did.
Without the mark's last line, the task's own reward is maximised.

    python docs/tutorials/ppo_with_giril.py --frames 200000 --demonstration folder
"""

from __future__ import annotations

import argparse

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.nn.distributions import NormalParamExtractor
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers import SamplerWithoutReplacement
from torchrl.envs import DoubleToFloat, GymEnv, RewardSum, StepCounter, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from giril_rl import IntrinsicReward  # GIRIL
from giril_rl.rewards import GenerativeReward, GenerativeRewardLoss, fit  # GIRIL


def make_env(name: str) -> TransformedEnv:
    """The task, with the episode's length and return noted."""
    env = TransformedEnv(GymEnv(name))
    env.append_transform(DoubleToFloat())
    env.append_transform(RewardSum())
    env.append_transform(StepCounter())
    return env


def demonstrate(env: TransformedEnv, steps: int) -> TensorDictBase:
    """What a heuristic for Pendulum-v1 does: swing up by energy, then hold."""

    def act(observation: torch.Tensor) -> torch.Tensor:
        cosine, sine, speed = observation.unbind(-1)
        missing = 15 * (1 - cosine) - speed.square() / 2  # energy, up to the balance
        push = torch.where(cosine > 0.9, -8 * sine - 2 * speed, missing * torch.sign(speed))
        return push.clamp(-2, 2).unsqueeze(-1)

    policy = TensorDictModule(act, ["observation"], ["action"])
    played = env.rollout(steps, policy, break_when_any_done=False)
    return played.select("observation", "action", ("next", "observation"))


def train(
    name: str = "Pendulum-v1",
    frames: int = 100_000,
    batch: int = 2048,
    epochs: int = 10,
    fit_steps: int = 2000,
    demonstration: TensorDictBase | None = None,
    seed: int = 0,
) -> list[float]:
    """Trains and returns, for each batch, the mean of the true return so far in the episode."""
    torch.manual_seed(seed)
    env = make_env(name)
    env.set_seed(seed)
    size, action = env.observation_spec["observation"].shape[-1], env.action_spec
    body = nn.Sequential(
        MLP(size, 2 * action.shape[-1], num_cells=[64, 64], activation_class=nn.Tanh),
        NormalParamExtractor(),
    )
    actor = ProbabilisticActor(
        TensorDictModule(body, ["observation"], ["loc", "scale"]),
        spec=action,
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": action.space.low, "high": action.space.high},
        return_log_prob=True,
    )
    critic = ValueOperator(MLP(size, 1, num_cells=[64, 64], activation_class=nn.Tanh))
    demo = demonstrate(env, 1000) if demonstration is None else demonstration

    reward = GenerativeReward.for_vectors(size, action)  # GIRIL
    fit(GenerativeRewardLoss(reward), demo, steps=fit_steps, lr=1e-3)  # GIRIL

    collector = Collector(
        env,
        actor,
        frames_per_batch=batch,
        total_frames=frames,
        postproc=IntrinsicReward(reward),  # GIRIL
        auto_register_policy_transforms=False,
    )
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(batch), sampler=SamplerWithoutReplacement(), batch_size=batch // 8
    )
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic)
    loss_module = ClipPPOLoss(actor, critic, clip_epsilon=0.2, normalize_advantage=True)
    optimizer = torch.optim.Adam(loss_module.parameters(), lr=3e-4)
    history = []
    for data in collector:
        for _ in range(epochs):
            with torch.no_grad():
                advantage(data)
            buffer.extend(data.reshape(-1))
            for minibatch in buffer:
                losses = loss_module(minibatch)
                loss = sum(losses[key] for key in losses.keys() if key.startswith("loss_"))
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(loss_module.parameters(), 0.5)
                optimizer.step()
        history.append(data["next", "episode_reward"].mean().item())
    collector.shutdown()
    return history


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="Pendulum-v1")
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--demonstration", help="a folder written by TensorDict.save()")
    args = parser.parse_args()
    given = None if args.demonstration is None else TensorDict.load(args.demonstration)
    for i, value in enumerate(train(args.env, args.frames, demonstration=given)):
        print(f"batch {i}: true return so far in an episode, mean {value:.1f}")
