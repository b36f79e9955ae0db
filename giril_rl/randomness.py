"""The state of torch's global generators, of the CPU and of the device that is in use."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from giril_rl.errors import UserError

CPU = torch.device("cpu")


def rng_state(device: torch.device) -> dict[str, Tensor]:
    """The generators' states, for a checkpoint.

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
    """Seeds the generators of the CPU and of ``device``, and puts them back afterwards.

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
    """Puts back what :func:`rng_state` gave."""
    torch.set_rng_state(state["cpu"])
    if "cuda" in state:
        torch.cuda.set_rng_state(state["cuda"])


def check_device(device: str) -> None:
    """Refuses a device that is not there, before anything is made.

    Raises:
        UserError: in one sentence.

    Examples:
        >>> check_device("cpu")
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise UserError(
            "device=cuda, and torch sees no GPU here: leave device=cpu, or install a CUDA build of "
            "torch."
        )
