"""Training speed of SAC with PWIL's reward on, paired with stable-baselines3's SAC.

Both train in turns in one process: the same environments, actor and two critics of two hidden
layers, minibatches and gradient steps for each environment step. Ours computes PWIL's reward
besides and draws from a replay buffer with the demonstration in it; stable-baselines3 learns from
the environment's own reward. Every round begins a training of its own. What a training takes to
begin, compiling above all, is measured by one of few steps and left out.

    pip install -e ".[benchmark]" && python tests/benchmarks/off_policy_loop.py
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from stable_baselines3 import SAC as StableSAC
from stable_baselines3.common.vec_env import DummyVecEnv
from tensordict import TensorDictBase
from torch import nn
from torchrl.envs import Compose

from giril_rl.config.schema import SACConfig, TaskConfig
from giril_rl.envs import gym_factory, make_env
from giril_rl.policies import make_sac_agent
from giril_rl.rewards.pwil import PWILConfig, pwil_reward
from giril_rl.rewards.trajectory import fresh_episodes
from giril_rl.training import SAC, Run, train_policy
from giril_rl.transforms import IntrinsicReward

BEGINNING = 192
"""Steps after which all that is made once was made; the first 64 are random."""


class Clocked(nn.Module):
    """A transform that adds up how long it takes."""

    def __init__(self, transform: nn.Module) -> None:
        super().__init__()
        self.transform, self.seconds = transform, 0.0

    def forward(self, batch: TensorDictBase) -> TensorDictBase:
        """The transform."""
        began = time.perf_counter()
        batch = self.transform(batch)
        self.seconds += time.perf_counter() - began
        return batch


def ours(task: TaskConfig, cfg: SACConfig) -> tuple[Callable[[int], None], Clocked]:
    """The whole loop of the recipe, its log and checkpoints included; and its reward."""
    env = make_env(task, 1, seed=0, use="demonstration")
    played = env.rollout(1000, break_when_any_done=False)
    reward = pwil_reward(PWILConfig(), env, played.squeeze(0))
    transform = Clocked(Compose(IntrinsicReward(reward)))
    with fresh_episodes(transform):
        demonstration = transform(played).squeeze(0)
    agent = make_sac_agent(env, cfg, seed=0)

    def train(steps: int) -> None:
        env = make_env(task, cfg.num_envs, seed=0)
        with (
            tempfile.TemporaryDirectory() as folder,
            Run.open(Path(folder) / "run", {}, recipe="benchmark") as run,
        ):
            sac = SAC(
                agent, cfg, steps=steps, folder=run.folder / "replay", demonstration=demonstration
            )
            train_policy(env, sac, transform, seed=0, run=run)

    return train, transform


def theirs(task: TaskConfig, cfg: SACConfig) -> Callable[[int], None]:
    """stable-baselines3's SAC, as many gradient steps after each step of all environments."""
    make: Any = gym_factory(task)

    def train(steps: int) -> None:
        model = StableSAC(
            "MlpPolicy",
            DummyVecEnv([make] * cfg.num_envs),
            batch_size=cfg.batch,
            learning_rate=cfg.lr,
            gamma=cfg.gamma,
            tau=cfg.tau,
            train_freq=cfg.rollout,
            gradient_steps=int(cfg.num_envs * cfg.rollout * cfg.updates),
            learning_starts=cfg.random_steps,
            policy_kwargs={"net_arch": list(cfg.hidden)},
            device="cpu",
            seed=0,
        )
        model.learn(steps)

    return train


def main() -> None:
    """Print steps per second of both and the ratio, pair by pair."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--env-id", default="HalfCheetahBulletEnv-v0")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=2_000, help="environment steps a round")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--hidden", type=int, default=256, help="units of each of two layers")
    parser.add_argument("--batch", type=int, default=256, help="transitions a minibatch")
    parser.add_argument("--updates", type=float, default=1.0, help="gradient steps a step")
    parser.add_argument("--compile", action="store_true", help="giril_rl's sac.compile=true")
    parser.add_argument("--precision", default="fp32", help="giril_rl's sac.precision")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(args.threads)
    cfg = SACConfig(
        hidden=[args.hidden] * 2,
        batch=args.batch,
        updates=args.updates,
        random_steps=64,
        lr=3e-4,
        compile=args.compile,
        precision=args.precision,
    )
    task = TaskConfig(name="task", env_id=args.env_id)
    train_ours, reward = ours(task, cfg)
    pair = {"giril_rl": train_ours, "stable-baselines3": theirs(task, cfg)}
    ratios, shares = [], []
    for number in range(args.rounds + 1):
        speed = {}
        for name, train in pair.items():
            seconds, paying = [], []
            for steps in (BEGINNING, BEGINNING + args.steps):
                began, reward.seconds = time.perf_counter(), 0.0
                train(steps)
                seconds.append(time.perf_counter() - began)
                paying.append(reward.seconds)
            speed[name] = args.steps / (seconds[1] - seconds[0])
            if train is train_ours:
                share = (paying[1] - paying[0]) / (seconds[1] - seconds[0])
        if number == 0:
            continue  # Warming up.
        ratios.append(speed["giril_rl"] / speed["stable-baselines3"])
        shown = ", ".join(f"{name} {value:,.0f} steps/s" for name, value in speed.items())
        shares.append(share)
        print(f"round {number}: {shown}, ratio {ratios[-1]:.2f}, PWIL {share:.1%}", flush=True)
    print(
        f"{args.env_id}: ratio {statistics.median(ratios):.2f} (median of {len(ratios)}, "
        f"{min(ratios):.2f} to {max(ratios):.2f}), PWIL {statistics.median(shares):.1%} of the loop"
    )


if __name__ == "__main__":
    main()
