"""Training stops where a loss is no longer a number, rather than going on for hours."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import nn

from giril_rl.errors import RunError


class Finite:
    """Looks at losses and weights before they are kept.

    Args:
        folder: the run's folder, for the sentence.
        total: steps of the whole training.
        unit: what a step is called.

    Examples:
        >>> check = Finite(Path("runs/a"), 2000)
        >>> check.losses({"ppo/loss_critic": 0.5}, 512)
        >>> check.losses({"ppo/loss_critic": float("nan")}, 1024)  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ...
        giril_rl.errors.RunError: ppo/loss_critic is nan at 1,024 of 2,000 steps: ...
    """

    def __init__(self, folder: Path, total: int, unit: str = "steps") -> None:
        self.folder, self.total, self.unit = folder, total, unit

    def losses(self, values: Mapping[str, float], step: int) -> None:
        """Raises RunError if one of ``values`` is NaN or infinite at ``step``."""
        for name, value in values.items():
            if not math.isfinite(value):
                raise self.error(f"{name} is {value}", step)

    def weights(self, module: nn.Module, step: int) -> None:
        """Raises RunError if a parameter of the module is not finite, or a buffer has a NaN.

        Buffers are running statistics, but also bounds of actions, which may be infinite.
        """
        for name, parameter in module.named_parameters():
            if not torch.isfinite(parameter).all():
                raise self.error(f"{name} has weights that are not finite", step)
        for name, buffer in module.named_buffers():
            if torch.isnan(buffer).any():
                raise self.error(f"{name} has statistics that are not numbers", step)

    def error(self, what: str, step: int) -> RunError:
        """What went wrong at ``step``, and what to do about it."""
        return RunError(
            f"{what} at {step:,} of {self.total:,} {self.unit}: give a smaller step size, or look "
            f"at the rewards and observations; what {self.folder} holds was saved before and is "
            "as it was."
        )
