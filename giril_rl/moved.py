"""Old names of modules and of what is in them, for one deprecation cycle: they work and warn."""

from __future__ import annotations

import importlib.util
import sys
import warnings
from collections.abc import Callable, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

MOVED = {
    "configs": "config.schema",
    "networks.acting": "policies.acting",
    "networks.agents": "policies.agents",
    "networks.pixel_policy": "policies.pixel_policy",
    "networks.policy": "policies.policy",
    "pretrained": "runs.pretrained",
    "training.checkpoint": "files.checkpoint",
    "training.run": "runs.run",
}
"""Modules below ``giril_rl`` that version 0.1 documented, or a copied recipe of its imports."""
NAMES = {
    "training.bottleneck_reward": "methods",
    "training.control_reward": "methods",
    "training.curiosity_reward": "methods",
    "training.discriminator_reward": "methods",
    "training.generative_reward": "methods",
}
"""Names that went to another module than the rest of theirs. A module that is still there finds its
own by ``__getattr__ = forwarding(__name__)``."""


def forwarding(module: str) -> Callable[[str], Any]:
    """A module's ``__getattr__``, which looks :data:`NAMES` up in their new places.

    Args:
        module: the module's full name.

    Examples:
        >>> forwarding("giril_rl.training")("anything")
        Traceback (most recent call last):
        ...
        AttributeError: module 'giril_rl.training' has no attribute 'anything'
    """
    below = module.partition(".")[2]

    def find(name: str) -> Any:
        new = NAMES.get(f"{below}.{name}")
        if new is not None:
            _warn(f"{module}.{name}", f"giril_rl.{new}.{name}")
            return getattr(importlib.import_module(f"giril_rl.{new}"), name)
        if below in MOVED:
            return getattr(importlib.import_module(f"giril_rl.{MOVED[below]}"), name)
        raise AttributeError(f"module {module!r} has no attribute {name!r}")

    return find


def _warn(old: str, new: str) -> None:
    warnings.warn(
        f"{old} is now {new}; the old name goes in version 0.3.", DeprecationWarning, stacklevel=3
    )


class MovedModules(MetaPathFinder, Loader):
    """Imports a module of :data:`MOVED` under its old name.

    Examples:
        >>> with warnings.catch_warnings(record=True) as said:
        ...     warnings.simplefilter("always")
        ...     from giril_rl.configs import TaskConfig
        >>> print(said[0].message)
        giril_rl.configs is now giril_rl.config.schema; the old name goes in version 0.3.
        >>> TaskConfig.__module__
        'giril_rl.config.schema'
    """

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """The spec of an old name, None of any other."""
        package, _, name = fullname.partition(".")
        if package != "giril_rl" or name not in MOVED:
            return None
        return importlib.util.spec_from_loader(fullname, self)

    def exec_module(self, module: ModuleType) -> None:
        """Lets the module find all names in its new place."""
        old = module.__name__
        new = f"giril_rl.{MOVED[old.partition('.')[2]]}"
        _warn(old, new)
        # At once: who looks through all modules for an attribute must not start an import.
        importlib.import_module(new)
        module.__getattr__ = forwarding(old)  # type: ignore[method-assign]


def install() -> None:
    """Makes the old names importable."""
    if not any(isinstance(finder, MovedModules) for finder in sys.meta_path):
        sys.meta_path.append(MovedModules())
