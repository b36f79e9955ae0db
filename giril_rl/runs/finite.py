"""Training stops where a loss is no longer a number, rather than going on for hours."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import torch
from tensordict import TensorDictBase
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

    def observations(self, batch: TensorDictBase, step: int) -> None:
        """Raises RunError if what was observed is not finite, before anything learns from it.

        An infinity may be clipped on its way to a loss, and spoil running statistics for good.
        """
        seen = batch.select("observation", ("next", "observation"))
        found = first_not_finite(seen)
        # After an action that is not finite any observation may come: the policy is to blame.
        if found is not None and first_not_finite(batch.select("action")) is None:
            raise self.error(found, step, "data")

    def losses(
        self, values: Mapping[str, float], step: int, batch: TensorDictBase | None = None
    ) -> None:
        """Raises RunError if one of ``values`` is NaN or infinite at ``step``.

        Args:
            values: losses by their names.
            step: the steps done.
            batch: what they were computed from; if it has a number of the kind itself, that is
                what the error names.
        """
        for name, value in values.items():
            if not math.isfinite(value):
                found = None if batch is None else first_not_finite(batch)
                if found is not None:
                    raise self.error(f"{found}, so that {name} is {value}", step, "data")
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

    def error(self, what: str, step: int, cause: str = "step size") -> RunError:
        """What went wrong at ``step``, and what to do where ``cause`` is "step size" or "data"."""
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
"""What is looked at first, in this order, for the rest follows from it."""


def first_not_finite(batch: TensorDictBase) -> str | None:
    """The first NaN or infinity of a batch and its place, None where all is finite.

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
