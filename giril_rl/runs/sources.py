"""The code that a run is made of besides the package's: a copied recipe, and modules beside it.

It is as much a part of what a run is as its settings are. ``versions.json`` has a digest of each,
and a run is neither continued nor taken for finished with another text.
"""

from __future__ import annotations

import hashlib
import importlib.util
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from giril_rl.config.recipes import Recipe
from giril_rl.errors import UserError
from giril_rl.files.disk import read_json

_making: ContextVar[tuple[Path, dict[str, str]] | None] = ContextVar("making", default=None)


def sources(recipe: Recipe, modules: Iterable[str]) -> dict[str, str]:
    """A digest of a copied recipe's file, and of each module that is a single file.

    A shipped recipe is known by the package's version.

    Args:
        recipe: the recipe.
        modules: names of modules; nothing is imported. Packages are passed over.

    Examples:
        >>> from giril_rl.config.recipes import find
        >>> sources(find("giril"), [])
        {}
    """
    found = {} if recipe.is_shipped else {"recipe": recipe.path}
    for name in modules:
        spec = None if "." in name else importlib.util.find_spec(name)
        if spec is not None and spec.origin is not None and spec.submodule_search_locations is None:
            found[name] = Path(spec.origin)
    return {
        name: hashlib.sha256(path.read_bytes()).hexdigest()[:16]
        for name, path in found.items()
        if path.is_file()
    }


@contextmanager
def making(folder: Path, digests: dict[str, str]) -> Iterator[None]:
    """While a recipe makes its run in ``folder``, that folder's :class:`Run` keeps ``digests``."""
    token = _making.set((folder.absolute(), digests))
    try:
        yield
    finally:
        _making.reset(token)


def sources_of(folder: Path) -> dict[str, str]:
    """The digests of the run that is being made in ``folder``, if one is."""
    current = _making.get()
    return current[1] if current is not None and current[0] == folder.absolute() else {}


def check_sources(folder: Path, now: Mapping[str, str]) -> None:
    """Refuses a run that was made with another text of its recipe or of a module.

    Runs that know nothing of their code pass.

    Raises:
        UserError: in one sentence.
    """
    path = folder / "versions.json"
    before: Any = read_json(path).get("sources") if now and path.is_file() else None
    if not isinstance(before, dict):
        return
    for name, digest in now.items():
        if before.get(name, digest) != digest:
            what = "recipe" if name == "recipe" else f"module {name}"
            raise UserError(
                f"{folder} was made with an earlier text of the {what}: to begin anew choose "
                "another out=, or delete the folder."
            )
