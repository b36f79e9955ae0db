"""Old names of modules, for one deprecation cycle: they work, warn and name the new one."""

from __future__ import annotations

import importlib.util
import sys
import warnings
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

MOVED = {
    "configs": "config.schema",
    "envs.atari_game": "envs.atari_preprocessing",
    "envs.atari_gym": "envs.atari_family",
    "envs.make": "envs.families",
    "networks.acting": "policies.acting",
    "networks.agents": "policies.agents",
    "networks.pixel_policy": "policies.pixel_policy",
    "networks.policy": "policies.policy",
    "pretrained": "runs.pretrained",
    "training.checkpoint": "files.checkpoint",
    "training.run": "runs.run",
}
"""What version 0.1 documented, or a copied recipe of its imports, below ``giril_rl``."""


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
