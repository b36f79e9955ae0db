"""GAIL from a Minari data set, on TorchRL's PPO.

The data set is read from where Minari keeps it (``minari download NAME`` fetches one); where it is
not there, one is made of what a heuristic for Pendulum-v1 does. The task has no failure, so that no
reward pays for staying alive. Lines marked with ``# GAIL`` are this
package's, all others are plain TorchRL.

    pip install -e ".[minari]"
    python docs/tutorials/gail_from_minari.py --dataset pendulum/heuristic-v0 --frames 300000
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import gymnasium
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from tensordict.nn.distributions import NormalParamExtractor
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers import SamplerWithoutReplacement
from torchrl.envs import Compose, DoubleToFloat, GymEnv, RewardSum, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from giril_rl import IntrinsicReward, ReturnScaling  # GAIL
from giril_rl.demos import (  # GAIL
    Demonstration,
    import_demonstration,
    named_task,
    record_demonstration,
    to_minari,
)
from giril_rl.rewards import DiscriminatorLoss, DiscriminatorReward  # GAIL

DATASET = "pendulum/heuristic-v0"


def collect(name: str, env_id: str, episodes: int) -> None:
    """Makes a Minari data set of a heuristic's play: swing up by energy, then hold."""

    def act(observation: torch.Tensor) -> torch.Tensor:
        cosine, sine, speed = observation.unbind(-1)
        missing = 15 * (1 - cosine) - speed.square() / 2  # energy, up to the balance
        push = torch.where(cosine > 0.9, -8 * sine - 2 * speed, missing * torch.sign(speed))
        return push.clamp(-2, 2).unsqueeze(-1)

    def make() -> gymnasium.Env:
        return gymnasium.make(env_id)

    played = record_demonstration(make, act, episodes=episodes, seed=0)  # GAIL
    to_minari(played, name, make, algorithm_name="heuristic")  # GAIL


def demonstration(name: str, env_id: str, episodes: int) -> Demonstration:
    """The data set as a checked demonstration; `giril demo import` does the same."""
    import minari

    if name not in minari.list_local_datasets():
        collect(name, env_id, episodes)
    task = named_task(None, env_id)
    return import_demonstration(f"minari:{name}", task, episodes=episodes)  # GAIL


def networks(size: int, action) -> tuple[ProbabilisticActor, ValueOperator]:
    """A policy with bounded actions, and its value network."""
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
    return actor, ValueOperator(MLP(size, 1, num_cells=[64, 64], activation_class=nn.Tanh))


def train(
    demo: Demonstration,
    frames: int = 300_000,
    batch: int = 2048,
    epochs: int = 10,
    updates: int = 10,
    gamma: float = 0.95,
    seed: int = 0,
) -> Iterator[dict[str, float]]:
    """Trains policy and discriminator; what to log, for each batch."""
    torch.manual_seed(seed)
    env = TransformedEnv(GymEnv(demo.card["env_id"]), Compose(DoubleToFloat(), RewardSum()))
    env.set_seed(seed)
    size, action = env.observation_spec["observation"].shape[-1], env.action_spec
    actor, critic = networks(size, action)

    # The discriminator, the reward made of its logit, and what trains it. "log_ratio" takes either
    # sign; the default, "positive", suits tasks that end by a failure: see docs/methods/gail.md.
    reward = DiscriminatorReward.for_vectors(size, action, form="log_ratio")  # GAIL
    reward.fit_scaler(demo.transitions["observation"])  # GAIL
    discriminator = DiscriminatorLoss(reward, penalty=1.0)  # GAIL
    judge = torch.optim.Adam(discriminator.parameters(), lr=1e-3)
    relabel = Compose(IntrinsicReward(reward), ReturnScaling(gamma))  # GAIL

    collector = Collector(
        env,
        actor,
        frames_per_batch=batch,
        total_frames=frames,
        auto_register_policy_transforms=False,
    )
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(batch), sampler=SamplerWithoutReplacement(), batch_size=batch // 8
    )
    advantage = GAE(gamma=gamma, lmbda=0.95, value_network=critic)
    loss_module = ClipPPOLoss(actor, critic, clip_epsilon=0.2, normalize_advantage=True)
    optimizer = torch.optim.Adam(loss_module.parameters(), lr=1e-3)
    pairs = demo.transitions.select("observation", "action")
    for data in collector:
        # First the discriminator learns to tell the expert's pairs from this batch's ...
        played = data.select("observation", "action").reshape(-1)
        for _ in range(updates):
            sets = {
                "expert": pairs[torch.randint(len(pairs), (256,))],
                "policy": played[torch.randint(len(played), (256,))],
            }
            told = discriminator(TensorDict(sets))  # GAIL
            judge.zero_grad()
            sum(told[key] for key in told.keys() if key.startswith("loss_")).backward()
            judge.step()
        # ... then the policy learns from what it makes of the batch.
        data = relabel(data)  # GAIL
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
        ends = data["next", "done"].squeeze(-1)
        yield {
            "true return": data["next", "episode_reward"][ends].mean().item(),
            "reward": data["next", "reward"].mean().item(),
            "accuracy on the expert": told["accuracy_expert"].item(),
            "accuracy on the policy": told["accuracy_policy"].item(),
        }
    collector.shutdown()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--dataset", default=DATASET)
    parser.add_argument("--env", default="Pendulum-v1", help="what it is a data set of")
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--frames", type=int, default=300_000)
    args = parser.parse_args()
    demo = demonstration(args.dataset, args.env, args.episodes)
    print(f"{len(demo)} transitions, mean true return {demo.returns.mean():.1f}")
    for i, log in enumerate(train(demo, args.frames)):
        print(f"batch {i}: " + ", ".join(f"{name} {value:.2f}" for name, value in log.items()))
