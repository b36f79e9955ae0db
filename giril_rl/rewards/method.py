"""The registry: what the suite knows of a method, in one entry, made in the method's own file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from tensordict.nn import TensorDictModuleBase
from torchrl.objectives import LossModule

from giril_rl.errors import UserError

BLUE, ORANGE, GREEN, PINK, BLACK = "#0072B2", "#E69F00", "#009E73", "#CC79A7", "#000000"
SKY, RED, GREY = "#56B4E9", "#D55E00", "#8C8C8C"
"""Okabe and Ito's colours, which people with colour blindness can tell apart, without the yellow,
which is hard to see on white."""
Kind = Literal["method", "control"]
Trained = Literal["before", "beside", "never"]
Scope = Literal["transition", "batch", "trajectory"]
Moments = Callable[[], tuple[float, float]]
"""Computes mean and variance of a reward over the demonstration."""


@dataclass(frozen=True)
class Method:
    """A method of imitation, or a control that stands in for one.

    Reports, parametrised tests, the controls' choices and the docs' index read these entries; none
    of them holds a list of methods.

    Attributes:
        name: what ``result.json`` has as ``method``: the recipe's name, ``control:REWARD`` of a
            control.
        label: its name in tables and legends.
        colour: of its lines.
        kind: "method" learns from a demonstration; "control" is what a method must beat.
        trained: when the reward model is trained: "before" the policy, "beside" it, or "never".
        demonstration: whether it needs one.
        settings: the dataclass of the reward's settings, None where it has none.
        build: ``build(settings, env, pairs, seed=seed)`` makes the reward module, untrained, its
            scaler fitted to ``pairs``; None where there is no reward.
        loss: ``loss(reward, settings)`` is what its training minimises; None where it is never
            trained, or not on single transitions.
        derive: of a control, ``derive(reward, moments, seed)`` makes its reward of the trained
            one; None where that one is used as it is.
        scope: what the reward of a transition depends on besides the reward's own state: the
            "transition" alone, the whole "batch" that it is computed with, or the "trajectory" so
            far.
        frames: whether it has a form for images.
        rank: its place in tables; those of equal rank are sorted by name.
    """

    name: str
    label: str
    colour: str
    kind: Kind = "method"
    trained: Trained = "before"
    scope: Scope = "transition"
    frames: bool = True
    demonstration: bool = True
    settings: type | None = None
    build: Callable[..., TensorDictModuleBase] | None = None
    loss: Callable[[Any, Any], LossModule] | None = None
    derive: Callable[[TensorDictModuleBase, Moments, int], TensorDictModuleBase] | None = None
    rank: int = 100


_REGISTERED: dict[str, Method] = {}


def register(method: Method) -> Method:
    """Adds a method to the registry, and returns it.

    Raises:
        UserError: if another method has the name.

    Examples:
        >>> nothing = register(Method("control:nothing", "nothing", GREY, kind="control"))
        >>> registered()["control:nothing"].label
        'nothing'
        >>> unregister("control:nothing")
    """
    known = _REGISTERED.setdefault(method.name, method)
    if known != method:
        raise UserError(f"there is a method {method.name} already: register yours by another name.")
    return method


def unregister(name: str) -> None:
    """Takes a method out of the registry again, as a test does with its own."""
    del _REGISTERED[name]


def registered() -> dict[str, Method]:
    """The methods of the modules that are imported so far, by name, in the order of tables."""
    return dict(sorted(_REGISTERED.items(), key=lambda item: (item[1].rank, item[0])))
