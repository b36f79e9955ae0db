"""Recipes as files: the shipped ones, copies of them, and how one is loaded.

A recipe is a Python file with a docstring, a dataclass ``Config`` (of
:class:`giril_rl.config.schema.RunConfig`) and ``main(cfg: Config, out: Path) -> None``. A copied
recipe has its settings beside it, in a YAML file of the same name. A shipped one has them in
``conf/NAME.yaml``, or shares ``conf/recipe.yaml``. Importing this module imports neither torch nor
Hydra.
"""

from __future__ import annotations

import ast
import importlib.util
import itertools
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass, is_dataclass
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from giril_rl.config.imports import missing, search_in
from giril_rl.config.nearest import did_you_mean
from giril_rl.config.schema import RunConfig
from giril_rl.errors import UserError, first_line
from giril_rl.files.untrusted import check_yaml, read_text


def shipped_folder() -> Path:
    """The folder of shipped recipes: inside an installed wheel, or beside the package's sources."""
    package = Path(__file__).resolve().parents[1]
    inside = package / "_recipes"
    return inside if inside.is_dir() else package.parent / "recipes"


def shipped_conf() -> Path:
    """The folder of the shipped recipes' YAML and of groups such as ``task`` and ``profile``."""
    return shipped_folder() / "conf"


@dataclass(frozen=True)
class Recipe:
    """A recipe's Python file and its YAML file.

    Attributes:
        word: its name or path on the command line.
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
        """Whether it comes with the package."""
        return self.path.parent == shipped_folder()

    @property
    def folders(self) -> list[Path]:
        """Where to look for the user's own modules, besides installed packages."""
        here = [Path.cwd()]
        return here if self.is_shipped else list(dict.fromkeys([self.path.parent, *here]))

    @property
    def docstring(self) -> str:
        """The file's docstring, read without running the file; empty where there is none."""
        return ast.get_docstring(self.tree()) or ""

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
        self.checked(getattr(module, "Config", None))
        if not callable(getattr(module, "main", None)):
            raise UserError(f"{self.path} has no `main(cfg, out)`.")
        return module

    def tree(self) -> ast.Module:
        """The file's syntax tree."""
        try:
            return ast.parse(self.path.read_text("utf-8"))
        except SyntaxError as error:
            raise UserError(
                f"{self.path} is not valid Python: {error.msg}, line {error.lineno}."
            ) from error
        except (ValueError, RecursionError, MemoryError) as error:
            raise UserError(f"{self.path} is not Python as UTF-8 text ({error}).") from error

    def _check_name(self) -> None:
        """Refuses a file, such as an early copy, that names its runs after another recipe."""
        for node in ast.walk(self.tree()):
            if not isinstance(node, ast.Call):
                continue
            called = getattr(node.func, "attr", getattr(node.func, "id", None))
            words = {word.arg: word.value for word in node.keywords}
            name = words.get("recipe") if called in ("open", "open_run", "train_expert") else None
            if isinstance(name, ast.Constant) and name.value != self.name:
                raise UserError(
                    f"{self.path}, line {name.lineno}: its runs would be called {name.value!r}, "
                    f"not {self.name!r} as the file: write recipe=Path(__file__).stem."
                )

    def checked(self, config: Any) -> type[Any]:
        """``config`` itself, refused unless it is a dataclass of RunConfig."""
        if isinstance(config, type) and is_dataclass(config) and issubclass(config, RunConfig):
            return config
        raise UserError(
            f"{self.path} has no `Config`, a dataclass of giril_rl.config.schema.RunConfig."
        )


def config_class(recipe: Recipe) -> type[Any]:
    """A recipe's ``Config``, for help and checks.

    A recipe imports TorchRL at its top, which takes seconds. Only the statements that ``Config``
    needs are run here: the recipe's, and those of the modules of this package that define its
    parts. Where they fail on their own, the whole file is loaded.

    Raises:
        UserError: as :meth:`Recipe.load`.

    Examples:
        >>> config_class(find("giril")).__name__
        'Config'
    """
    if recipe.docstring:
        if not recipe.is_shipped:
            search_in(*recipe.folders)
        try:
            return recipe.checked(_defined("Config", recipe.path, recipe.name))
        except Exception:
            # The whole file either works or says what is wrong with it.
            pass
    return recipe.load().Config


_READINGS = itertools.count()


def _defined(name: str, path: Path, module_name: str) -> Any:
    """What ``name`` is in a file of which only the statements that it needs are run."""
    # A name of its own for each: dataclasses look up their module by it when their annotations are
    # read, and what a later reading defines are other classes.
    module = ModuleType(f"giril_config_of_{module_name}.{name}.{next(_READINGS)}")
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
    """Whether a module of this package may import TorchRL, and is not imported yet."""
    light = "giril_rl.config", "giril_rl.errors"
    ours = module.startswith("giril_rl.") and not module.startswith(light)
    return ours and module not in sys.modules


def _imported(name: str, module: str) -> Any:
    """A class of settings of a heavy module, by its own statements; of all else, the import."""
    path = Path(__file__).parents[1].joinpath(*module.split(".")[1:])
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    for statement in ast.parse(path.read_text("utf-8")).body:
        if name in _bound(statement) and isinstance(statement, ast.ClassDef):
            return _defined(name, path, module)
        if name in _bound(statement) and isinstance(statement, ast.ImportFrom):
            return _imported(name, statement.module or "")
    return getattr(import_module(module), name)


def _needed_for(name: str, body: list[ast.stmt]) -> tuple[list[ast.stmt], set[str]]:
    """The top-level statements that ``name`` needs, in their order, and all names in them."""
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
    """The names that a statement binds."""
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


def shipped() -> list[Recipe]:
    """All shipped recipes, by name.

    Examples:
        >>> "giril" in [recipe.name for recipe in shipped()]
        True
    """
    found = []
    for path in sorted(shipped_folder().glob("[!_]*.py")):
        own = shipped_conf() / f"{path.stem}.yaml"
        settings = own if own.is_file() else shipped_conf() / "recipe.yaml"
        found.append(Recipe(path.stem, path, settings))
    return found


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


def load_yaml(path: Path) -> Any:
    """A YAML file of settings that anybody may have written, as OmegaConf reads it.

    OmegaConf takes 1e-4 for a number and refuses a key that is given twice.

    Raises:
        UserError: where it is not valid YAML, or not safe to read.
    """
    try:
        check_yaml(read_text(path))
        return OmegaConf.load(path)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "not valid"
        raise UserError(f"{path} is not valid YAML{line}: {problem}; correct it.") from error
    except (OSError, ValueError, OmegaConfBaseException) as error:
        raise UserError(f"{path} cannot be read as YAML: {first_line(error)}.") from error
