"""Old names of modules and of what is in them, for one deprecation cycle: they work and warn."""

from __future__ import annotations

import functools
import importlib.util
import sys
import warnings
from collections.abc import Callable, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any, TypeVar, cast

Function = TypeVar("Function", bound=Callable[..., Any])

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
    "training.adversarial": "training.reward_trainers",
    "training.checkpoint": "runs.checkpoint",
    "training.clone": "training.cloning",
    "training.evaluate": "training.scoring",
    "training.expert": "training.demonstrations",
    "training.fit": "training.fitting",
    "training.run": "runs.run",
}
"""Modules below ``giril_rl`` that version 0.1 documented, or a copied recipe of its imports."""
NAMES = {
    "config.schema.AdversarialConfig": "rewards",
    "config.schema.BottleneckConfig": "rewards",
    "config.schema.ControlRunConfig": "methods",
    "config.schema.CuriosityConfig": "rewards",
    "config.schema.GenerativeConfig": "rewards",
    "configs.RunConfig": "config.schema:AveragedRunConfig",
    "training.AdversarialLearner": "training.deprecated",
    "training.PPOLearner": "training.deprecated",
    "training.RewardLearner": "training.deprecated",
    "training.bottleneck_reward": "rewards",
    "training.control_reward": "methods",
    "training.curiosity_reward": "rewards",
    "training.discriminator_reward": "rewards",
    "training.generative_reward": "rewards",
    "training.train_ppo": "training.deprecated",
}
"""Names that went to another module than the rest of theirs, as ``MODULE`` or ``MODULE:NAME``. A
module that is still there finds its own by ``__getattr__ = forwarding(__name__)``."""


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
            new, _, renamed = new.partition(":")
            renamed = renamed or name
            _warn(f"{module}.{name}", f"giril_rl.{new}.{renamed}")
            return getattr(importlib.import_module(f"giril_rl.{new}"), renamed)
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


def renamed_argument(old: str, new: str | None) -> Callable[[Function], Function]:
    """Lets a function take an argument by its old name too, with a warning.

    Args:
        old: the old name.
        new: the new one; None for an argument that is not read any more.

    Examples:
        >>> @renamed_argument("held_out", "validation")
        ... def fit(validation=None):
        ...     return validation
        >>> with warnings.catch_warnings(record=True) as said:
        ...     warnings.simplefilter("always")
        ...     fit(held_out=3)
        3
        >>> print(said[0].message)
        fit(held_out=...) is now validation=; the old name goes in version 0.3.
    """

    def decorate(function: Function) -> Function:
        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            if old in kwargs:
                _warn(f"{function.__name__}({old}=...)", f"{new}=" if new else "not read")
                value = kwargs.pop(old)
                kwargs.update({new: value} if new else {})
            return function(*args, **kwargs)

        return cast(Function, call)

    return decorate
