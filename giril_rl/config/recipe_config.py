"""A recipe's ``Config`` without importing what only its ``main`` needs.

A recipe reads best with its imports at the top, but importing TorchRL takes seconds. Help and
refusals need ``Config`` alone, so only the statements that define it are run: the recipe's, and
those of the modules of this package that define its parts.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

from giril_rl.config.imports import search_in
from giril_rl.config.recipe_files import Recipe

_PACKAGE = Path(__file__).parents[1]
_LIGHT = "giril_rl.config", "giril_rl.errors"
"""Modules of the package that import nothing heavy."""


def config_class(recipe: Recipe) -> type[Any]:
    """The recipe's ``Config``, for help and checks; a run takes that of the loaded recipe.

    If the statements fail on their own, the whole recipe is loaded.

    Raises:
        UserError: where the file is no recipe, see :class:`~giril_rl.config.recipe_files.Recipe`.

    Examples:
        >>> from giril_rl.config.recipe_files import find
        >>> config_class(find("giril")).__name__
        'Config'
    """
    if recipe.docstring:
        if not recipe.is_shipped:
            search_in(*recipe.folders)
        try:
            return recipe.check_config(_defined("Config", recipe.path, recipe.name))
        except Exception:
            # The whole file either works or says what is wrong with it.
            pass
    return recipe.load().Config


def _defined(name: str, path: Path, module_name: str) -> Any:
    """What ``name`` is in a file of which only the statements that it needs are run."""
    module = ModuleType(f"giril_config_of_{module_name}.{name}")
    # Dataclasses look up their module by name when their annotations are read.
    sys.modules[module.__name__] = module
    run: list[ast.stmt] = []
    statements, names = _needed_for(name, ast.parse(path.read_text("utf-8")).body)
    for statement in statements:
        if isinstance(statement, ast.ImportFrom) and _is_heavy(statement.module or ""):
            for alias in statement.names:
                if (bound := alias.asname or alias.name) in names:
                    setattr(module, bound, _imported(alias.name, statement.module or ""))
        else:
            run.append(statement)
    exec(compile(ast.Module(run, []), str(path), "exec", dont_inherit=True), module.__dict__)
    return getattr(module, name)


def _is_heavy(module: str) -> bool:
    ours = module.startswith("giril_rl.") and not module.startswith(_LIGHT)
    return ours and module not in sys.modules


def _imported(name: str, module: str) -> Any:
    """A class of settings of a heavy module, by its own statements; of all else, the import."""
    path = _PACKAGE.joinpath(*module.split(".")[1:])
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    for statement in ast.parse(path.read_text("utf-8")).body:
        if name in _bound(statement) and isinstance(statement, ast.ClassDef):
            return _defined(name, path, module)
        if name in _bound(statement) and isinstance(statement, ast.ImportFrom):
            return _imported(name, statement.module or "")
    return getattr(__import__(module, fromlist=[name]), name)


def _needed_for(name: str, body: list[ast.stmt]) -> tuple[list[ast.stmt], set[str]]:
    """The statements that ``name`` needs, in their order, and all names in them."""
    needed, kept = {name, "annotations"}, set[int]()
    while True:
        new = [
            index
            for index, statement in enumerate(body)
            if index not in kept and needed & set(_bound(statement))
        ]
        if not new:
            return [body[index] for index in sorted(kept)], needed
        kept.update(new)
        for index in new:
            needed |= {node.id for node in ast.walk(body[index]) if isinstance(node, ast.Name)}


def _bound(statement: ast.stmt) -> Iterator[str]:
    if isinstance(statement, (ast.ClassDef, ast.FunctionDef)):
        yield statement.name
        return
    for node in ast.walk(statement):
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            for alias in node.names:
                yield (alias.asname or alias.name).partition(".")[0]
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
        elif isinstance(node, (ast.ClassDef, ast.FunctionDef)):
            yield node.name
