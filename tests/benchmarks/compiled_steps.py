"""What compiling saves of a gradient step on frames, each pair in turns in one process.

PYTHONPATH=tests python tests/benchmarks/compiled_steps.py
"""

from __future__ import annotations

import argparse
import statistics
import time
import warnings

import torch
from frame_losses import CASES

from giril_rl.graphs import TracedGradients

SIZES = {"ppo": 256, "giril": 32, "cdil": 32, "gail": 128, "vail": 128}
"""Transitions in a step as the recipes have them."""


def seconds(made: TracedGradients, inputs: list[torch.Tensor], steps: int) -> float:
    """Seconds a step."""
    began = time.perf_counter()
    for _ in range(steps):
        made.step(inputs)
    if inputs[0].is_cuda:
        torch.cuda.synchronize()
    return (time.perf_counter() - began) / steps


def main() -> None:
    """Print each loss's times and their ratio."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--steps", type=int, default=10, help="steps of a round")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(args.threads)
    for name, size in SIZES.items():
        made, columns = CASES[name](size)
        loss, keys = made.module.loss.to(args.device), made._keys
        inputs = [column.to(args.device) for column in columns]
        plain = TracedGradients(loss, keys=keys)
        fast = TracedGradients(loss, keys=keys, compile=True)
        first = seconds(fast, inputs, 1)
        seconds(plain, inputs, 1)
        pairs = [
            (seconds(plain, inputs, args.steps), seconds(fast, inputs, args.steps))
            for _ in range(args.rounds)
        ]
        before, after = (statistics.median(column) * 1e3 for column in zip(*pairs, strict=True))
        ratios = [one / other for one, other in pairs]
        print(
            f"{name:<6} {size:>4} transitions: {before:7.1f} ms, compiled {after:7.1f} ms, "
            f"{statistics.median(ratios):.2f} times ({min(ratios):.2f} to {max(ratios):.2f}); "
            f"first step after {first:.0f} s",
            flush=True,
        )


if __name__ == "__main__":
    main()
