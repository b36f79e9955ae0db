"""A recipe's ``Config`` without what only its ``main`` needs.

A recipe reads best with its imports at the top, and importing TorchRL takes seconds. Help and
refusals need only ``Config``, so the few statements that it is made of are run alone.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from types import ModuleType
from typing import Any

from giril_rl.config.imports import search_in
from giril_rl.config.recipe_files import Recipe


def config_class(recipe: Recipe) -> type[Any]:
    """The recipe's ``Config``, for help and checks; a run takes the one of the loaded recipe.

    Where the statements cannot be told apart (they fail on their own), the whole recipe is loaded.

    Raises:
        UserError: where the file is no recipe, see :class:`~giril_rl.config.recipe_files.Recipe`.

    Examples:
        >>> from giril_rl.config.recipe_files import find
        >>> config_class(find("giril")).__name__
        'Config'
    """
    module = ModuleType(f"giril_recipe_config_{recipe.name}")
    sys.modules[module.__name__] = module
    if recipe.docstring:
        body = _needed_for("Config", ast.parse(recipe.path.read_text("utf-8")).body)
        if not recipe.is_shipped:
            search_in(*recipe.folders)
        code = compile(ast.Module(body, []), str(recipe.path), "exec", dont_inherit=True)
        try:
            exec(code, module.__dict__)
            return recipe.check_config(module.Config)
        except Exception:
            # The whole file either works or says what is wrong with it.
            pass
    return recipe.load().Config


def _needed_for(name: str, body: list[ast.stmt]) -> list[ast.stmt]:
    needed, kept = {name, "annotations"}, set[int]()
    while True:
        new = [
            index
            for index, statement in enumerate(body)
            if index not in kept and needed & set(_bound(statement))
        ]
        if not new:
            return [body[index] for index in sorted(kept)]
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
