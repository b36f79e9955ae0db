"""Training speed with the learned reward on, paired with stable-baselines3's PPO.

Both train in turns in one process on one thread: the same environments, two networks of two hidden
layers of 100, rollout, epochs and minibatch size, and running normalisation of observations. Ours
computes GIRIL's reward and scales it besides; stable-baselines3 learns from the environment's own
reward, scaled by its VecNormalize.

    pip install -e ".[benchmark]" && python tests/benchmarks/training_loop.py
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import gymnasium
import torch
from stable_baselines3 import PPO as StablePPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torchrl.envs import Compose

from giril_rl.config.schema import PPOConfig, TaskConfig
from giril_rl.envs import gym_factory, make_env
from giril_rl.rewards import GenerativeReward
from giril_rl.training import PPO, Run, make_agent, train_policy
from giril_rl.transforms import BatchMeanReward, IntrinsicReward, ReturnScaling

ENV_IDS = {
    "inverted_pendulum": "InvertedPendulumBulletEnv-v0",
    "inverted_double_pendulum": "InvertedDoublePendulumBulletEnv-v0",
}


def ours(task: TaskConfig, cfg: PPOConfig) -> Callable[[int], None]:
    """The whole loop of the recipes, its log and checkpoints included."""
    env = make_env(task, cfg.num_envs, seed=0)
    agent = make_agent(env, cfg, seed=0)
    reward = GenerativeReward.for_vectors(
        env.observation_spec["observation"].shape[-1], env.action_spec
    )
    reward.scaler.fit(env.rollout(200, break_when_any_done=False)["observation"].flatten(0, 1))
    relabel = Compose(IntrinsicReward(reward), BatchMeanReward(), ReturnScaling(cfg.gamma))

    def train(steps: int) -> None:
        env = make_env(task, cfg.num_envs, seed=0)
        with (
            tempfile.TemporaryDirectory() as folder,
            Run.open(Path(folder) / "run", {}, recipe="benchmark") as run,
        ):
            train_policy(env, PPO(agent, cfg, steps=steps), relabel, seed=0, run=run)

    return train


def theirs(task: TaskConfig, cfg: PPOConfig) -> Callable[[int], None]:
    """stable-baselines3's PPO behind its VecNormalize."""
    make: Callable[[], gymnasium.Env] = gym_factory(task)
    model = StablePPO(
        "MlpPolicy",
        VecNormalize(DummyVecEnv([make] * cfg.num_envs), gamma=cfg.gamma),
        n_steps=cfg.rollout,
        batch_size=cfg.minibatch,
        n_epochs=cfg.epochs,
        clip_range=cfg.clip,
        learning_rate=cfg.lr,
        ent_coef=cfg.entropy_coef,
        vf_coef=cfg.value_coef,
        policy_kwargs={"net_arch": list(cfg.hidden)},
        device="cpu",
        seed=0,
    )

    def train(steps: int) -> None:
        model.learn(steps, reset_num_timesteps=False)

    return train


def main() -> None:
    """Print steps per second of both and the ratio, pair by pair."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--task", choices=ENV_IDS, default="inverted_pendulum")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--batches", type=int, default=50, help="batches a round")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    cfg = PPOConfig()
    task = TaskConfig(name=args.task, env_id=ENV_IDS[args.task])
    steps = args.batches * cfg.num_envs * cfg.rollout
    pair = {"giril_rl": ours(task, cfg), "stable-baselines3": theirs(task, cfg)}
    ratios = []
    for number in range(args.rounds + 1):
        speed = {}
        for name, train in pair.items():
            began = time.perf_counter()
            train(steps)
            speed[name] = steps / (time.perf_counter() - began)
        if number == 0:
            continue  # Warming up.
        ratios.append(speed["giril_rl"] / speed["stable-baselines3"])
        shown = ", ".join(f"{name} {value:,.0f} steps/s" for name, value in speed.items())
        print(f"round {number}: {shown}, ratio {ratios[-1]:.2f}", flush=True)
    print(
        f"{args.task}: ratio {statistics.median(ratios):.2f} (median of {len(ratios)}, "
        f"{min(ratios):.2f} to {max(ratios):.2f})"
    )


if __name__ == "__main__":
    main()
