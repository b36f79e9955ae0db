"""How long GIRIL's pixel model takes to fit: 50,000 steps of 32 transitions, from fewer.

python tests/benchmarks/pixel_fit.py [--device cuda] [--steps 100] [--threads 2]
"""

from __future__ import annotations

import argparse
import os
import tempfile
import warnings
from pathlib import Path

import torch

from giril_rl.config.schema import FitConfig
from giril_rl.demos import Demonstration, named_task, shipped_demonstrations, subsample
from giril_rl.envs import make_env
from giril_rl.rewards import GenerativeReward, GenerativeRewardLoss
from giril_rl.training import Run, fit_reward

WHOLE = FitConfig().steps


def main() -> None:
    """Fit the shipped demonstration of Breakout and print the rate."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--compile", action="store_true")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(args.threads)
    demo = subsample(Demonstration.load(shipped_demonstrations()["breakout"][0]), 4)
    env = make_env(named_task("breakout", None), 1, seed=0)
    loss = GenerativeRewardLoss(GenerativeReward.for_pixels(env.action_spec).to(args.device))
    # The first steps choose algorithms, and each block ends with the losses of the whole set.
    for steps in (10, args.steps):
        cfg = FitConfig(steps=steps, log_every=steps, compile=args.compile)
        with (
            tempfile.TemporaryDirectory() as folder,
            Run.open(Path(folder) / "run", {}, recipe="benchmark") as run,
        ):
            seconds = fit_reward(loss, demo, cfg, seed=0, run=run)
    rate = args.steps / seconds
    print(f"{args.device}, {args.threads} threads: {rate:,.1f} steps/s of {cfg.batch} transitions")
    print(f"{WHOLE:,} steps: {WHOLE / rate / 60:,.1f} minutes")


if __name__ == "__main__":
    main()
