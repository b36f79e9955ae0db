"""All methods that the suite has."""

from __future__ import annotations

import pkgutil
from importlib import import_module

import giril_rl.rewards
import giril_rl.training
from giril_rl.rewards.method import Method, registered

CONTROL = "control:"


def methods() -> dict[str, Method]:
    """Every method and control by its name, in the order of tables.

    A file in ``giril_rl/rewards`` or ``giril_rl/training`` that registers a method is all that it
    takes. A recipe of your own may register one too.

    Examples:
        >>> methods()["giril"].label
        'GIRIL'
    """
    for package in (giril_rl.rewards, giril_rl.training):
        for module in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
            import_module(module.name)
    return registered()


def controls() -> dict[str, Method]:
    """The controls by their names in the recipe `control`.

    Examples:
        >>> controls()["copy"].label
        'control: copy'
    """
    return {
        name.removeprefix(CONTROL): method
        for name, method in methods().items()
        if method.kind == "control"
    }
