"""Atari training speed with GIRIL's reward on, paired with stable-baselines3's PPO.

Both train in turns, each in a process of its own, with the same number of torch threads: 8 games
(stable-baselines3 steps them one after another, ours run in ale-py's threads), 128 steps, 4 epochs,
minibatches of 256, the same networks (three convolutions and a layer of 512).
Ours computes GIRIL's reward at beta = 1 and scales it besides, as ``giril run`` does;
stable-baselines3 learns from the clipped score, behind its own wrappers (``make_atari_env``,
``VecFrameStack``).

    pip install -e ".[atari,benchmark]" opencv-python-headless
    python tests/benchmarks/atari_training.py

A round begins with new games, of which each takes a tenth of a second to seed: on a fast machine
give ``--batches 100``.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import statistics
import tempfile
import time
import warnings
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path

import ale_py
import gymnasium
import torch
from stable_baselines3 import PPO as StablePPO
from stable_baselines3.common.env_util import make_atari_env
from stable_baselines3.common.vec_env import VecFrameStack
from torchrl.envs import Compose

from giril_rl.config.schema import RunConfig, TaskConfig
from giril_rl.config.tasks import apply_task_defaults
from giril_rl.envs import make_env
from giril_rl.rewards import GenerativeReward
from giril_rl.runs.machine import keep_freed_memory
from giril_rl.training import PPO, Run, make_agent, train_policy
from giril_rl.transforms import BatchMeanReward, IntrinsicReward, ReturnScaling


def ours(config: RunConfig, device: str) -> Callable[[int], None]:
    """The whole loop of the recipes, its log and checkpoints included."""
    env = make_env(config.task, config.ppo.num_envs, seed=0)
    agent = make_agent(env, config.ppo, seed=0).to(device)
    reward = GenerativeReward.for_pixels(env.action_spec).eval()
    env.close()
    relabel = Compose(IntrinsicReward(reward), BatchMeanReward(), ReturnScaling(config.ppo.gamma))

    def train(steps: int) -> None:
        env = make_env(config.task, config.ppo.num_envs, seed=0)
        with (
            tempfile.TemporaryDirectory() as folder,
            Run.open(Path(folder) / "run", {}, recipe="benchmark") as run,
        ):
            train_policy(env, PPO(agent, config.ppo, steps=steps), relabel, seed=0, run=run)

    return train


def theirs(config: RunConfig, device: str) -> Callable[[int], None]:
    """stable-baselines3's PPO, its CnnPolicy and its Atari wrappers."""
    gymnasium.register_envs(ale_py)
    cfg = config.ppo
    game = config.task.env_id.removeprefix("ALE/").removesuffix("-v5")
    model = StablePPO(
        "CnnPolicy",
        VecFrameStack(make_atari_env(f"{game}NoFrameskip-v4", cfg.num_envs, seed=0), 4),
        n_steps=cfg.rollout,
        batch_size=cfg.minibatch,
        n_epochs=cfg.epochs,
        clip_range=cfg.clip,
        clip_range_vf=cfg.clip,
        learning_rate=cfg.lr,
        ent_coef=cfg.entropy_coef,
        vf_coef=cfg.value_coef,
        device=device,
        seed=0,
    )

    def train(steps: int) -> None:
        model.learn(steps, reset_num_timesteps=False)

    return train


def serve(name: str, config: RunConfig, device: str, threads: int, pipe: Connection) -> None:
    """Trains for as many steps as are sent, and sends the seconds that it took; 0 ends it."""
    warnings.simplefilter("ignore")
    torch.set_num_threads(threads)
    if name == "giril_rl":
        keep_freed_memory()  # As the command line does.
    train = {"giril_rl": ours, "stable-baselines3": theirs}[name](config, device)
    while steps := pipe.recv():
        began = time.perf_counter()
        train(steps)
        pipe.send(time.perf_counter() - began)


def main() -> None:
    """Print steps per second of both and the ratio, pair by pair."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--game", default="Breakout", help="as in ALE/Breakout-v5")
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--device", default="cpu", help="of both, such as cuda")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--batches", type=int, default=6, help="batches of a round")
    parser.add_argument(
        "--num-envs", type=int, default=8, help="games; a batch is 128 steps of each"
    )
    parser.add_argument("--minibatch", type=int, default=256, help="transitions in a gradient step")
    parser.add_argument("--compile", action="store_true", help="ours, its gradient steps")
    args = parser.parse_args()
    task = TaskConfig(name=args.game, env_id=f"ALE/{args.game}-v5")
    config = apply_task_defaults(RunConfig(task=task))
    config.ppo.num_envs, config.ppo.minibatch = args.num_envs, args.minibatch
    config.ppo.compile = args.compile
    steps = args.batches * config.ppo.num_envs * config.ppo.rollout
    spawning = multiprocessing.get_context("spawn")
    pair = {}
    for name in ("giril_rl", "stable-baselines3"):
        pair[name], theirs_end = spawning.Pipe()
        settings = (name, config, args.device, args.threads, theirs_end)
        spawning.Process(target=serve, args=settings, daemon=True).start()
    ratios = []
    for number in range(args.rounds + 1):
        speed = {}
        for name, pipe in pair.items():
            pipe.send(steps if number else steps // args.batches)
            speed[name] = steps / pipe.recv()
        if number == 0:
            continue  # Warming up.
        ratios.append(speed["giril_rl"] / speed["stable-baselines3"])
        shown = ", ".join(f"{name} {value:,.0f} steps/s" for name, value in speed.items())
        print(f"round {number}: {shown}, ratio {ratios[-1]:.2f}", flush=True)
    for pipe in pair.values():
        pipe.send(0)
    print(
        f"{args.game}, {args.device}, {args.threads} threads: "
        f"ratio {statistics.median(ratios):.2f} "
        f"(median of {len(ratios)}, {min(ratios):.2f} to {max(ratios):.2f})"
    )


if __name__ == "__main__":
    main()
