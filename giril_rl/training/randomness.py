"""The state of torch's global generators, of the CPU and of the device that is in use."""

from __future__ import annotations

import torch
from torch import Tensor

from giril_rl.errors import UserError


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
