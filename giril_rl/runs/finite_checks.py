"""Stops training as soon as a loss, a weight or an observation is NaN or infinite."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import nn

from giril_rl.errors import RunError


class Finite:
    """Checks batches, losses and weights before they are used or saved.

    Args:
        folder: the run's folder, for the message.
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

    def observations(self, batch: TensorDictBase, step: int) -> None:
        """Raises RunError if an observation is NaN or infinite, before anything learns from it.

        A loss may not show it: an infinity can be clipped on the way, and yet spoil running
        statistics for good.
        """
        seen = batch.select("observation", ("next", "observation"))
        found = first_not_finite(seen)
        # A NaN action explains any observation after it: then the policy is to blame.
        if found is not None and first_not_finite(batch.select("action")) is None:
            raise self.error(found, step, "data")

    def losses(
        self, values: Mapping[str, float], step: int, batch: TensorDictBase | None = None
    ) -> None:
        """Raises RunError if one of ``values`` is NaN or infinite.

        Args:
            values: losses by name.
            step: steps done.
            batch: the data of these losses; if the NaN or infinity is in there, the error names it.
        """
        for name, value in values.items():
            if not math.isfinite(value):
                found = None if batch is None else first_not_finite(batch)
                if found is not None:
                    raise self.error(f"{found}, so that {name} is {value}", step, "data")
                raise self.error(f"{name} is {value}", step)

    def weights(self, module: nn.Module, step: int) -> None:
        """Raises RunError if a parameter is NaN or infinite, or a buffer has a NaN.

        Infinite buffers are allowed: the bounds of an action may be.
        """
        for name, parameter in module.named_parameters():
            if not torch.isfinite(parameter).all():
                raise self.error(f"{name} has weights that are not finite", step)
        for name, buffer in module.named_buffers():
            if torch.isnan(buffer).any():
                raise self.error(f"{name} has statistics that are not numbers", step)

    def error(self, what: str, step: int, cause: str = "step size") -> RunError:
        """The error for ``step``; ``cause`` ("step size" or "data") decides what it advises."""
        remedy = (
            "give a smaller step size, or look at the rewards and observations"
            if cause == "step size"
            else "see where that comes from, the environment, the demonstration or a reward"
        )
        return RunError(
            f"{what} at {step:,} of {self.total:,} {self.unit}: {remedy}; what {self.folder} holds "
            "was saved before and is as it was."
        )


DATA = ("observation", "normalised", "action", ("next", "observation"), ("next", "reward"))
"""The keys to check, in this order, if a batch has any of them: the others follow from them."""


def first_not_finite(batch: TensorDictBase) -> str | None:
    """The first NaN or infinity in a batch, with its index; None if there is none.

    Examples:
        >>> from tensordict import TensorDict
        >>> observation = torch.zeros(2, 5, 3)
        >>> observation[1, 4, 2] = float("nan")
        >>> batch = TensorDict({"action": torch.zeros(2, 5), "observation": observation}, [2, 5])
        >>> first_not_finite(batch)
        'observation is nan at [1, 4, 2] of the batch'
    """
    held = list(batch.keys(include_nested=True, leaves_only=True))
    for key in [key for key in DATA if key in held] or held:
        value = batch.get(key)
        if not value.is_floating_point() or torch.isfinite(value).all():
            continue
        place = tuple((~torch.isfinite(value)).nonzero()[0].tolist())
        name = key if isinstance(key, str) else " ".join(key)
        return f"{name} is {value[place].item()} at {list(place)} of the batch"
    return None
