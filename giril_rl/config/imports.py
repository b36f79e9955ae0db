"""Modules of the user's own, whose import registers environments.

A module is imported only if the user named it: on the command line, in a recipe or in Python. What
a run's folder, a demonstration or a study's file names is not.
"""

from __future__ import annotations

import importlib
import importlib.util
import re
import sys
import traceback
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from giril_rl.config.schema import split_id
from giril_rl.errors import UserError

_MODULE = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*")


def named_modules(env_id: object, imports: object = ()) -> list[str]:
    """The modules that settings name: those of ``imports``, and the one before an id's colon.

    Anybody may have written the settings: what is not the name of a module is passed over.

    Examples:
        >>> named_modules("my_envs:Ball-v0", ["more.envs", "my_envs"])
        ['more.envs', 'my_envs']
        >>> named_modules("Pendulum-v1"), named_modules(3, {"a": 1})
        ([], [])
    """
    found = list(imports) if isinstance(imports, (list, tuple)) else []
    found.append(split_id(env_id)[0] if isinstance(env_id, str) else None)
    named = [name for name in found if isinstance(name, str) and _MODULE.fullmatch(name)]
    return list(dict.fromkeys(named))


def modules_of(config: Any) -> list[str]:
    """:func:`named_modules` of a recipe's ``Config``."""
    return named_modules(config.task.env_id, config.imports)


def check_names(imports: Iterable[str]) -> None:
    """Refuses what cannot be the name of a module.

    Examples:
        >>> check_names(["my_envs", "a.b"])
        >>> check_names(["my_envs.py", "no/such"])
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: 'my_envs.py' is a file: import it by its name, my_envs.
    """
    for name in imports:
        stem, dot, suffix = name.rpartition(".")
        if dot and suffix == "py":
            raise UserError(f"{name!r} is a file: import it by its name, {Path(stem).name}.")
        if not _MODULE.fullmatch(name):
            raise UserError(f"{name!r} is not the name of a module: write one such as my_envs.")


def search_in(*folders: Path) -> None:
    """Lets Python find modules in these folders too.

    They come last, so that a file there cannot take the place of an installed package.
    """
    sys.path += [str(folder) for folder in folders if str(folder) not in sys.path]


def import_modules(names: Sequence[str], *folders: Path) -> None:
    """Imports modules that the user named.

    Args:
        names: the modules.
        folders: where to look besides the installed packages.

    Raises:
        UserError: for one that is not found or cannot be imported.

    Examples:
        >>> import_modules(["no_such_module"], Path("/my/folder"))
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: there is no module no_such_module among the installed packages
        or in /my/folder: install it, or put it there.
    """
    check_names(names)
    if names:
        search_in(*folders)
    for name in names:
        try:
            importlib.import_module(name)
        except ModuleNotFoundError as error:
            raise missing(name, error, *folders) from error
        except Exception as error:
            frames = traceback.extract_tb(error.__traceback__)
            place = f"{frames[-1].filename}, line {frames[-1].lineno}: " if frames else ""
            reason = f"{place}{type(error).__name__}: {' '.join(str(error).split())}"
            raise UserError(
                f"the module {name} cannot be imported ({reason}): correct it."
            ) from error


def check_found(names: Sequence[str], *folders: Path) -> None:
    """Refuses modules that :func:`import_modules` would not find, without importing anything."""
    if names:
        search_in(*folders)
    for name in names:
        top = name.partition(".")[0]
        if top not in sys.modules and importlib.util.find_spec(top) is None:
            raise missing(name, ModuleNotFoundError(name=top), *folders)


def missing(name: str, error: ModuleNotFoundError, *folders: Path) -> UserError:
    """The refusal of a module, or of a recipe's file, that needs one that is not there."""
    absent = error.name or name
    who = f"there is no module {absent}"
    if not name.startswith(absent):
        who = f"{name} imports {absent}, and there is no such module"
    places = " or ".join(dict.fromkeys(f"in {folder}" for folder in folders))
    where = f"among the installed packages{' or ' if places else ''}{places}"
    return UserError(f"{who} {where}: install it, or put it there.")
