"""From a recipe and ``key=value`` texts to the recipe's ``Config``, through Hydra's Compose API.

The Compose API rather than ``@hydra.main``: the latter owns the process (it parses the command
line, changes the exit codes and prints its own multi-line errors), and this command line promises
refusals of one sentence, its own exit codes and several recipes behind one command. What is
composed, the override grammar and the sweeps are Hydra's all the same.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Any

from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.errors import HydraException
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from giril_rl.config.families import GYMNASIUM, family_of
from giril_rl.config.leaves import flat
from giril_rl.config.overrides import KeyCheck, check_settings, normalised, parse
from giril_rl.config.recipe_files import Recipe, shipped_conf
from giril_rl.config.task_defaults import apply_task_defaults
from giril_rl.errors import UserError
from giril_rl.files.untrusted import check_references, check_yaml, read_text

SCHEMA = "recipe_schema"
"""The entry in a YAML's defaults list that stands for the recipe's own ``Config`` class."""
_GROUP = re.compile(r"\w[\w-]*")
_CHOICE = re.compile(r"\w[\w.+-]*")


@dataclass(frozen=True)
class Composed:
    """A composed configuration: unresolved, with the changes that made it.

    Attributes:
        node: Hydra's result, of the recipe's ``Config`` type.
        changes: the user's overrides as ``{key: "key=value"}`` in one spelling.
        written: dotted keys that the recipe's own YAML sets.
    """

    node: DictConfig
    changes: dict[str, str]
    written: frozenset[str] = frozenset()

    @property
    def chosen(self) -> frozenset[str]:
        """Dotted keys that somebody chose, who then wins over the kind of task."""
        return self.written | self.changes.keys()

    def missing(self) -> list[str]:
        """Dotted keys of mandatory values that nobody has given."""
        return list(_missing(OmegaConf.to_container(self.node, resolve=False)))

    def config(self) -> Any:
        """The instance of ``Config`` with every interpolation resolved, for its kind of task.

        Raises:
            UserError: where a mandatory value is missing or an interpolation leads nowhere.
        """
        values = OmegaConf.to_container(self.node, resolve=False)
        check_references(values)
        for key in _missing(values):
            hint = "Pendulum-v1" if key == "task.env_id" else "VALUE"
            raise UserError(f"{key} has no value: give one, such as {key}={hint}.")
        try:
            OmegaConf.resolve(self.node)
            built = OmegaConf.to_object(self.node)
        except (OmegaConfBaseException, RecursionError) as error:
            full_key = getattr(error, "full_key", None)
            where = f"{full_key}: " if full_key else "in ${...}: "
            raise UserError(f"{where}{_first_line(error)}; write the value itself.") from error
        return apply_task_defaults(built, self.chosen)


def _missing(values: Any, prefix: str = "") -> Iterator[str]:
    # Not OmegaConf.missing_keys: it raises at an interpolation of a missing value.
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _missing(value, f"{prefix}{name}.")
        elif value == "???":
            yield f"{prefix}{name}"


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")


def _load(path: Path) -> Any:
    import yaml

    try:
        check_yaml(read_text(path))
        return OmegaConf.load(path)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark else ""
        raise UserError(f"{path} is not valid YAML{line}.") from error
    except (OSError, ValueError, OmegaConfBaseException) as error:
        raise UserError(f"{path} cannot be read: {_first_line(error)}.") from error


def _load_settings(recipe: Recipe) -> DictConfig:
    loaded = _load(recipe.yaml)
    defaults = loaded.get("defaults") if isinstance(loaded, DictConfig) else None
    if not isinstance(defaults, ListConfig) or SCHEMA not in defaults:
        raise UserError(f"{recipe.yaml} needs a `defaults` list with `{SCHEMA}` in it.")
    for entry in OmegaConf.to_container(defaults, resolve=False) or ():
        if entry not in (SCHEMA, "_self_") and not _names_a_choice(entry):
            raise UserError(
                f"{recipe.yaml}: {entry!r} in `defaults` is not of the form `group: choice`, with "
                "the name of a folder and of a file in it."
            )
    return loaded


def _names_a_choice(entry: Any) -> bool:
    """Whether an entry is ``group: choice``; paths, packages and Hydra's own groups are not.

    Nothing chosen, ``group: null``, is a choice as well.
    """
    if not isinstance(entry, dict) or len(entry) != 1 or "hydra" in entry:
        return False
    ((group, choice),) = entry.items()
    return (
        isinstance(group, str)
        and _GROUP.fullmatch(group) is not None
        and (choice is None or (isinstance(choice, str) and _CHOICE.fullmatch(choice) is not None))
    )


def groups(recipe: Recipe) -> dict[str, tuple[list[str], str]]:
    """A recipe's config groups, each with all its choices and the default one.

    A group is what the YAML's defaults list names as ``group: choice``; its choices are the files
    in the folder of that name beside the YAML and among the shipped settings.

    Examples:
        >>> from giril_rl.config.recipe_files import find
        >>> groups(find("giril"))["profile"]
        (['paper', 'released'], 'released')
    """
    found = {}
    for entry in _load_settings(recipe).defaults:
        if isinstance(entry, DictConfig):
            ((group, default),) = entry.items()
            folders = (recipe.yaml.parent / str(group), shipped_conf() / str(group))
            names = {file.stem for folder in folders for file in folder.glob("*.yaml")}
            found[str(group)] = (sorted(names), str(default))
    return found


def _with_task(texts: Sequence[str], tasks: Collection[str]) -> list[str]:
    given = dict(text.partition("=")[::2] for text in texts)
    if "task.env_id" in given and "task" not in given:
        name = family_of(given["task.env_id"].strip("'\"")).name
        return [f"task={name if name in tasks else GYMNASIUM.name}", *texts]
    return list(texts)


def compose(recipe: Recipe, config: type[Any], texts: Sequence[str]) -> Composed:
    """Compose one configuration; values may still be missing or interpolations.

    ``task.env_id=X`` without ``task=`` chooses the task ``gymnasium``, or ``atari`` for an id like
    ``ALE/Pong-v5``, named after the environment.

    Args:
        recipe: whose YAML is the primary configuration.
        config: the recipe's ``Config`` class, which fixes keys and types.
        texts: ``key=value``, one value each.

    Raises:
        UserError: one sentence that names the override or file at fault.

    Examples:
        >>> from giril_rl.config.schema import RunConfig
        >>> from giril_rl.config.recipe_files import find
        >>> composed = compose(find("giril"), RunConfig, ["task.env_id=Pendulum-v1", "steps=1000"])
        >>> composed.config().task.name, composed.config().steps
        ('Pendulum-v1', 1000)
    """
    found = groups(recipe)
    choices = {group: names for group, (names, _) in found.items()}
    check = KeyCheck(recipe.word, config, choices)
    settings = OmegaConf.to_container(_load_settings(recipe), resolve=False)
    assert isinstance(settings, dict)
    check_settings(check, settings, str(recipe.yaml))  # type: ignore[arg-type]
    overrides = parse(_with_task(texts, choices.get("task", ())))
    for override in overrides:
        check.override(override)
    chosen: dict[str, Any] = {group: default for group, (_, default) in found.items()}
    chosen |= {key: o.value() for o in overrides if (key := o.get_key_element()) in found}
    for group, choice in chosen.items():
        own = recipe.yaml.parent / group / f"{choice}.yaml"
        if own.is_file():
            _load(own)

    ConfigStore.instance().store(name=SCHEMA, node=config)
    lines = [normalised(override) for override in overrides]
    search = f"hydra.searchpath=[{_quoted('file://' + str(shipped_conf()))}]"
    try:
        with initialize_config_dir(config_dir=str(recipe.yaml.parent), version_base="1.3"):
            node = hydra_compose(recipe.yaml.name, [*lines, search])
    except (HydraException, OmegaConfBaseException) as error:
        cause = error.__cause__ if isinstance(error.__cause__, Exception) else error
        raise UserError(f"{recipe.yaml} cannot be composed: {_first_line(cause)}.") from error
    changes = {override.get_key_element(): normalised(override) for override in overrides}
    written = flat({key: value for key, value in settings.items() if key != "defaults"})
    return Composed(node, changes, frozenset(written))


def _quoted(text: str) -> str:
    escaped = text.replace("'", "\\'")
    return f"'{escaped}'"


def resolved(recipe: Recipe, config: type[Any], texts: Sequence[str]) -> tuple[Any, dict[str, str]]:
    """The validated ``Config`` of one job and the user's changes, see :class:`Composed`.

    Raises:
        UserError: as :func:`compose`, and for values that
            :func:`~giril_rl.config.validation.validate` refuses.
    """
    from giril_rl.config.validation import validate

    composed = compose(recipe, config, texts)
    built = composed.config()
    assert is_dataclass(built)
    validate(built)
    return built, composed.changes
