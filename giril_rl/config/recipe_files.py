"""Recipes as files: the shipped ones, copies of them, and how one is loaded.

A recipe is a Python file with a docstring, a dataclass ``Config`` (of
:class:`giril_rl.config.schema.RunConfig`) and ``main(cfg: Config, out: Path) -> None``. Its
settings are a YAML file: ``conf/NAME.yaml`` for a shipped recipe, the same name with the suffix
``.yaml`` beside a copied one. Importing this module imports neither torch nor Hydra.
"""

from __future__ import annotations

import ast
import importlib.util
import shutil
import sys
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from giril_rl.config.imports import missing, search_in
from giril_rl.config.nearest import did_you_mean
from giril_rl.config.schema import RunConfig
from giril_rl.errors import UserError


def shipped_folder() -> Path:
    """The folder of shipped recipes: inside an installed wheel, or beside the package's sources."""
    package = Path(__file__).resolve().parents[1]
    inside = package / "_recipes"
    return inside if inside.is_dir() else package.parent / "recipes"


def shipped_conf() -> Path:
    """The folder of the shipped recipes' YAML and of its groups ``task`` and ``profile``."""
    return shipped_folder() / "conf"


@dataclass(frozen=True)
class Recipe:
    """A recipe's Python file and its YAML file.

    Attributes:
        word: what names it on the command line, a name or a path.
        path: its Python file.
        yaml: its settings.
    """

    word: str
    path: Path
    yaml: Path

    @property
    def name(self) -> str:
        """The file's name without its suffix, used for folders."""
        return self.path.stem

    @property
    def is_shipped(self) -> bool:
        """Whether it is the package's own rather than a copy."""
        return self.path.parent == shipped_folder()

    @property
    def folders(self) -> list[Path]:
        """Where modules of the user's own are looked for, besides installed packages."""
        here = [Path.cwd()]
        return here if self.is_shipped else list(dict.fromkeys([self.path.parent, *here]))

    @property
    def docstring(self) -> str:
        """The file's docstring, read without running the file; empty where there is none."""
        try:
            return ast.get_docstring(ast.parse(self.path.read_text("utf-8"))) or ""
        except SyntaxError as error:
            raise UserError(
                f"{self.path} is not valid Python: {error.msg}, line {error.lineno}."
            ) from error
        except (ValueError, RecursionError, MemoryError) as error:
            raise UserError(f"{self.path} is not Python as UTF-8 text ({error}).") from error

    def load(self) -> ModuleType:
        """Run the recipe's file as a module and check that it has ``Config`` and ``main``.

        Raises:
            UserError: where it has not, or imports a module that is not there.
        """
        self._check_name()
        name = f"giril_recipe_{self.name}"
        spec = importlib.util.spec_from_file_location(name, self.path)
        if not self.docstring or spec is None or spec.loader is None:
            raise UserError(
                f"{self.path} begins with no docstring: say there what the recipe does."
            )
        module = importlib.util.module_from_spec(spec)
        # Dataclasses look up their module by name when their annotations are read.
        sys.modules[name] = module
        if not self.is_shipped:
            search_in(*self.folders)
        try:
            spec.loader.exec_module(module)
        except ModuleNotFoundError as error:
            raise missing(str(self.path), error, *self.folders) from error
        self.check_config(getattr(module, "Config", None))
        if not callable(getattr(module, "main", None)):
            raise UserError(f"{self.path} has no `main(cfg, out)`.")
        return module

    def _check_name(self) -> None:
        """Refuse a file, such as an early copy, whose runs would be called as another recipe's."""
        tree = ast.parse(self.path.read_text("utf-8") if self.docstring else "")
        for node in ast.walk(tree):
            if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Attribute):
                continue
            words = {word.arg: word.value for word in node.keywords}
            name = words.get("recipe") if node.func.attr == "open" else None
            if isinstance(name, ast.Constant) and name.value != self.name:
                raise UserError(
                    f"{self.path}, line {name.lineno}: its runs would be called {name.value!r}, "
                    f"not {self.name!r} as the file: write recipe=Path(__file__).stem."
                )

    def check_config(self, config: Any) -> type[Any]:
        """``config`` itself, refused unless it is a dataclass of RunConfig."""
        if isinstance(config, type) and is_dataclass(config) and issubclass(config, RunConfig):
            return config
        raise UserError(
            f"{self.path} has no `Config`, a dataclass of giril_rl.config.schema.RunConfig."
        )


def shipped() -> list[Recipe]:
    """All shipped recipes, by name.

    Examples:
        >>> "giril" in [recipe.name for recipe in shipped()]
        True
    """
    return [
        Recipe(path.stem, path, shipped_conf() / f"{path.stem}.yaml")
        for path in sorted(shipped_folder().glob("*.py"))
        if not path.stem.startswith("_")
    ]


def find(text: str) -> Recipe:
    """The recipe that a user named: a shipped one's name, or the path of a copied file.

    Args:
        text: a name such as ``giril`` or a path that ends in ``.py``.

    Raises:
        UserError: for an unknown name, a missing file, a file without its YAML, or one with the
            name of a shipped recipe.

    Examples:
        >>> find("girl")
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: 'girl' is not a recipe; did you mean 'giril'?
    """
    by_name = {recipe.name: recipe for recipe in shipped()}
    if text.endswith(".py"):
        path = Path(text)
        if not path.is_file():
            raise UserError(f"there is no file {text}; `giril cp RECIPE {text}` makes one.")
        settings = path.with_suffix(".yaml")
        if not settings.is_file():
            raise UserError(f"{text} needs its settings in {settings}: `giril cp` copies both.")
        found = Recipe(text, path.resolve(), settings.resolve())
        own = by_name.get(found.name.partition(":")[0])
        if own is not None and own.path.resolve() != found.path:
            raise UserError(
                f"{text} has the name of the recipe {own.name}, whose runs its own would be "
                "taken for: rename both files."
            )
        return found
    if text not in by_name:
        hint = did_you_mean(text, by_name) or f": choose one of {', '.join(by_name)}."
        raise UserError(f"{text!r} is not a recipe{hint}")
    return by_name[text]


def copy(recipe: Recipe, file: Path) -> tuple[Path, Path]:
    """Copy a recipe's Python to ``file`` and its YAML beside it, and return both paths.

    Raises:
        UserError: where ``file`` does not end in ``.py``, or anything would be overwritten.
    """
    if file.suffix != ".py":
        raise UserError(f"{file} does not end in .py: a recipe is a Python file.")
    settings = file.with_suffix(".yaml")
    for target in (file, settings):
        if target.exists():
            raise UserError(f"{target} exists: remove it or choose another name.")
    if not file.parent.is_dir():
        raise UserError(f"{file} cannot be written: there is no folder {file.parent}.")
    shutil.copyfile(recipe.path, file)
    shutil.copyfile(recipe.yaml, settings)
    return file, settings
