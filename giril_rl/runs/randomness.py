"""Random numbers: a seed for each use, and the state of torch's global generators."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal, get_args

import torch
from torch import Tensor

CPU = torch.device("cpu")
Use = Literal["player", "demonstration", "training", "evaluation", "reward", "ranking"]
_USES = get_args(Use)


def stream_seed(use: Use, *numbers: int, bits: int = 63) -> int:
    """A seed for one use, never equal to a seed for another use.

    The first three bits are the use, the others a hash of use and numbers. So one run's ``seed``
    gives the player, its demonstration, the policy's training, its evaluation and the reward model
    random numbers and start states of their own.

    Args:
        use: what the random numbers are for.
        numbers: tell the seeds of one use apart, such as the run's seed.
        bits: size of the seed: 63 for torch, 32 for simulators.

    Examples:
        >>> uses = ("player", "demonstration", "training", "evaluation", "reward")
        >>> len({stream_seed(use, seed, bits=32) for use in uses for seed in range(1000)})
        5000
        >>> [stream_seed(use, 0, bits=32) >> 29 for use in uses]
        [0, 1, 2, 3, 4]
    """
    text = "/".join(map(str, (use, *numbers)))
    hashed = int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big")
    free = bits - 3
    return _USES.index(use) << free | hashed >> (64 - free)


def rng_state(device: torch.device) -> dict[str, Tensor]:
    """The state of torch's generators on the CPU and on ``device``, for a checkpoint.

    Examples:
        >>> list(rng_state(torch.device("cpu")))
        ['cpu']
    """
    state = {"cpu": torch.get_rng_state()}
    if device.type == "cuda":
        state["cuda"] = torch.cuda.get_rng_state(device)
    return state


@contextmanager
def seeded(seed: int, device: torch.device = CPU) -> Iterator[None]:
    """Seed the generators of the CPU and of ``device``; restore their state afterwards.

    Examples:
        >>> state = torch.get_rng_state()
        >>> with seeded(3):
        ...     first = torch.rand(1)
        >>> with seeded(3):
        ...     bool(torch.rand(1) == first)
        True
        >>> torch.equal(torch.get_rng_state(), state)
        True
    """
    on_gpu = device.type == "cuda"
    with torch.random.fork_rng(devices=[device] if on_gpu else []):
        torch.default_generator.manual_seed(seed)
        if on_gpu:
            with torch.cuda.device(device):
                torch.cuda.manual_seed(seed)
        yield


def restore_rng(state: dict[str, Tensor]) -> None:
    """Set torch's generators to a state from :func:`rng_state`."""
    torch.set_rng_state(state["cpu"])
    if "cuda" in state:
        torch.cuda.set_rng_state(state["cuda"])
