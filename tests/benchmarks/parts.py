"""What the hand-written parts save over the library's, each pair in turns in one process.

python tests/benchmarks/parts.py [--compile]
"""

from __future__ import annotations

import argparse
import statistics
import time
import warnings
from collections.abc import Callable

import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.data import Bounded
from torchrl.envs import GymWrapper
from torchrl.modules import IndependentNormal
from torchrl.objectives import ClipPPOLoss

from giril_rl.config.schema import TaskConfig
from giril_rl.envs import gym_factory, make_env
from giril_rl.graphs import TracedGradients
from giril_rl.networks.distributions import DiagonalGaussian
from giril_rl.policies import NORMALISED, ActorCritic, RecordedActing
from giril_rl.training.ppo import LOSS_KEYS

TASK = TaskConfig(name="inverted_pendulum", env_id="InvertedPendulumBulletEnv-v0")


def seconds(function: Callable[[], object], repeat: int) -> float:
    """Seconds a call, over ``repeat`` calls."""
    began = time.perf_counter()
    for _ in range(repeat):
        function()
    return (time.perf_counter() - began) / repeat


def compare(title: str, calls: dict[str, Callable[[], object]], repeat: int, rounds: int) -> None:
    """Print each call's median time and how many times faster the first one is."""
    for call in calls.values():
        seconds(call, max(repeat // 4, 1))
    times = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            times[name].append(seconds(call, repeat))
    print(title)
    first = next(iter(times))
    for name, values in times.items():
        ratio = statistics.median(b / a for a, b in zip(times[first], values, strict=True))
        print(f"  {name:<32} {statistics.median(values) * 1e3:9.3f} ms  {ratio:5.2f} x")


def environments() -> dict[str, Callable[[], object]]:
    """A batch of 16 x 100 steps collected with the same lean policy."""
    make = gym_factory(TASK)
    sync = SyncVectorEnv([make] * 16, autoreset_mode=AutoresetMode.DISABLED)
    calls = {}
    for name, env in {
        "GymVectorEnv": make_env(TASK, 16, seed=0),
        "GymWrapper(SyncVectorEnv)": GymWrapper(sync),
    }.items():
        policy = ActorCritic(5, env.action_spec).acting()
        collector = Collector(
            env,
            policy,
            frames_per_batch=1600,
            total_frames=-1,
            track_traj_ids=False,
            trust_policy=True,
            auto_register_policy_transforms=False,
        )
        calls[name] = iter(collector).__next__
    return calls


def gradients(compiled: bool) -> dict[str, Callable[[], object]]:
    """ClipPPOLoss and its gradient for a minibatch of 250."""
    agent = ActorCritic(5, Bounded(-1.0, 1.0, shape=(1,)))
    loss = ClipPPOLoss(
        agent.actor_for_loss(),
        agent.critic_for_loss(),
        clip_epsilon=0.1,
        entropy_bonus=False,
        loss_critic_type="l2",
        normalize_advantage=False,
        functional=False,
        log_explained_variance=False,
    )
    keys = (NORMALISED, agent.drawn_key, *LOSS_KEYS)
    shapes = {key: (250, 1) for key in keys} | {"action_log_prob": (250,), NORMALISED: (250, 5)}
    batch = TensorDict({key: torch.randn(shape) for key, shape in shapes.items()}, [250])
    traced = TracedGradients(loss, keys=keys)

    def total() -> torch.Tensor:
        out = loss(batch)
        return out["loss_objective"] + out["loss_critic"]

    def eager() -> None:
        loss.zero_grad()
        total().backward()

    calls: dict[str, Callable[[], object]] = {"TracedGradients": lambda: traced(batch)}
    calls["ClipPPOLoss, eager"] = eager
    if compiled:
        fast = torch.compile(total)

        def compiled_step() -> None:
            loss.zero_grad()
            fast().backward()

        began = time.perf_counter()
        compiled_step()
        print(f"torch.compile: first step after {time.perf_counter() - began:.1f} s")
        calls["ClipPPOLoss, torch.compile"] = compiled_step
    return calls


def distributions() -> dict[str, Callable[[], object]]:
    """Sample 16 actions and take their log-probability."""
    mean, log_std = torch.zeros(16, 1), torch.zeros(1)

    def ours() -> None:
        distribution = DiagonalGaussian(mean, log_std)
        distribution.log_prob(distribution.sample())

    def theirs() -> None:
        distribution = IndependentNormal(mean, log_std.exp().expand_as(mean))
        distribution.log_prob(distribution.sample())

    return {"DiagonalGaussian": ours, "IndependentNormal": theirs}


def acting() -> dict[str, Callable[[], object]]:
    """Act on the observations of 16 environments."""
    agent = ActorCritic(5, Bounded(-1.0, 1.0, shape=(16, 1)))
    seen = torch.randn(16, 5)
    recorded, plain = RecordedActing(agent), agent.acting()
    return {
        "RecordedActing": lambda: recorded(TensorDict({"observation": seen}, [16])),
        "ActingPolicy": lambda: plain(TensorDict({"observation": seen}, [16])),
    }


def main() -> None:
    """Print all comparisons."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--compile", action="store_true", help="compare torch.compile as well")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    compare("collecting 16 x 100 steps", environments(), repeat=3, rounds=7)
    compare("loss and gradient", gradients(args.compile), repeat=200, rounds=7)
    compare("acting in 16 environments", acting(), repeat=1000, rounds=7)
    compare("sample and log-probability", distributions(), repeat=1000, rounds=7)


if __name__ == "__main__":
    main()
