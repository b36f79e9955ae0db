"""Old names, for one deprecation cycle: they work, warn and name the new one."""

from __future__ import annotations

import importlib.util
import sys
import warnings
from collections.abc import Mapping, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

MOVED = {
    "configs": "config.schema",
    "envs.atari_game": "envs.atari_preprocessing",
    "envs.atari_gym": "envs.atari_family",
    "envs.make": "envs.families",
    "methods.control_rewards": "methods.controls",
    "networks.acting": "policies.agent",
    "networks.agents": "policies.making",
    "networks.pixel_discriminators": "networks.pixels",
    "networks.pixel_policy": "policies.pixel_actor_critic",
    "networks.policy": "policies.actor_critic",
    "pretrained": "runs.pretrained",
    "rewards.affine": "rewards.controls",
    "rewards.bottleneck_loss": "rewards.bottleneck",
    "rewards.chunks": "rewards.transitions",
    "rewards.constant": "rewards.controls",
    "rewards.copy": "rewards.controls",
    "rewards.curiosity_loss": "rewards.curiosity",
    "rewards.discriminator_loss": "rewards.discriminator",
    "rewards.equations": "rewards.generative",
    "rewards.generative_loss": "rewards.generative",
    "rewards.noise": "rewards.controls",
    "rewards.pixel_scaler": "rewards.scaler",
    "rewards.transition_loss": "rewards.fitting",
    "training.checkpoint": "runs.checkpoint",
    "training.run": "runs.run",
}
"""Modules that version 0.1 documented, or that its recipes import, below ``giril_rl``."""

MOVED_NAMES: Mapping[str, Mapping[str, str]] = {
    "config.schema": {
        "AdversarialConfig": "rewards",
        "BottleneckConfig": "rewards",
        "ControlRunConfig": "methods.controls",
        "CuriosityConfig": "rewards",
        "GenerativeConfig": "rewards",
    },
}
"""Names that left a module that is still there, and the modules that they are in now."""


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
        """Looks all names up in the module's new place."""
        old = module.__name__
        new = f"giril_rl.{MOVED[old.partition('.')[2]]}"
        warnings.warn(
            f"{old} is now {new}; the old name goes in version 0.3.",
            DeprecationWarning,
            stacklevel=2,
        )
        found = importlib.import_module(new)
        module.__getattr__ = found.__getattribute__  # type: ignore[method-assign]


def install() -> None:
    """Lets the old names be imported, which is asked for once."""
    if not any(isinstance(finder, MovedModules) for finder in sys.meta_path):
        sys.meta_path.append(MovedModules())


def find(module: str, name: str) -> Any:
    """What ``name`` of ``module`` is now, for the ``__getattr__`` of a module in MOVED_NAMES.

    Raises:
        AttributeError: if the module never had the name.
    """
    new = MOVED_NAMES[module].get(name)
    if new is None:
        raise AttributeError(f"module 'giril_rl.{module}' has no attribute {name!r}")
    warnings.warn(
        f"giril_rl.{module}.{name} is now giril_rl.{new}.{name}; the old name goes in version 0.3.",
        DeprecationWarning,
        stacklevel=3,
    )
    return getattr(importlib.import_module(f"giril_rl.{new}"), name)
