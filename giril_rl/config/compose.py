"""From a recipe and ``key=value`` texts to the recipe's ``Config``, through Hydra's Compose API.

Not ``@hydra.main``: it owns the process (command line, exit codes, errors of several lines), and
this command line has several recipes behind one command and refuses in one sentence. What is
composed, the override grammar and the sweeps are Hydra's.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.errors import HydraException
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from giril_rl.config.families import GYMNASIUM, family_of
from giril_rl.config.knobs import default_text, flat
from giril_rl.config.overrides import KeyCheck, normalised, parse, words_by_key
from giril_rl.config.recipes import Recipe, load_yaml, shipped_conf
from giril_rl.config.schema import RunConfig, idle_algorithm
from giril_rl.config.tasks import apply_task_defaults
from giril_rl.config.validation import validate
from giril_rl.errors import UserError, first_line
from giril_rl.files.untrusted import check_references

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
        """Dotted keys that somebody chose, which win over the defaults of a task's kind."""
        return self.written | self.changes.keys()

    def config(self) -> Any:
        """The instance of ``Config``, interpolations resolved and the task's defaults applied.

        Raises:
            UserError: where a mandatory value is missing or an interpolation leads nowhere.
        """
        values = OmegaConf.to_container(self.node, resolve=False)
        check_references(values)
        # Not OmegaConf.missing_keys: it raises at an interpolation of a missing value.
        for key, value in flat(values).items():  # type: ignore[arg-type]
            if value == "???":
                hint = "Pendulum-v1" if key == "task.env_id" else "VALUE"
                raise UserError(f"{key} has no value: give one, such as {key}={hint}.")
        try:
            # Not `resolve`, which would change the node.
            built = OmegaConf.to_object(self.node)
        except (OmegaConfBaseException, RecursionError) as error:
            full_key = getattr(error, "full_key", None)
            where = f"{full_key}: " if full_key else "in ${...}: "
            raise UserError(f"{where}{first_line(error)}; write the value itself.") from error
        return apply_task_defaults(built, self.chosen)


@dataclass(frozen=True)
class Job:
    """One job of a command line or a study.

    Attributes:
        config: the validated configuration.
        changes: ``{key: "key=value"}`` of what makes a difference, in one spelling: the same for
            the same configuration, however it was asked for.
        words: the texts of those, as they were given.
    """

    config: Any
    changes: dict[str, str]
    words: tuple[str, ...]


class Composer:
    """Composes the configurations of one recipe, whose files it reads once.

    Hydra takes a tenth of a second for the recipe's YAML and its chosen groups, and is asked once
    for each choice of them; overrides of single keys are applied to a copy.

    Args:
        recipe: whose YAML is the primary configuration.
        schema: the recipe's ``Config`` class, which fixes keys and types.

    Raises:
        UserError: for a mistake in the YAML.

    Examples:
        >>> from giril_rl.config.recipes import config_class, find
        >>> giril = find("giril")
        >>> composer = Composer(giril, config_class(giril))
        >>> words = ["seed=3", "profile=paper", "batch_mean=false", "ppo.lr=3e-4", "ppo.clip=0.20"]
        >>> job = composer.job(words)
        >>> job.changes
        {'ppo.clip': 'ppo.clip=0.2', 'profile': 'profile=paper', 'seed': 'seed=3'}
        >>> job.words
        ('profile=paper', 'ppo.clip=0.20', 'seed=3')
    """

    def __init__(self, recipe: Recipe, schema: type[Any]) -> None:
        self.recipe, self.schema = recipe, schema
        self.groups = groups(recipe)
        settings: Any = OmegaConf.to_container(_load_settings(recipe), resolve=False)
        del settings["defaults"]
        self._check = KeyCheck(recipe.word, schema, {g: c for g, (c, _) in self.groups.items()})
        self._check.settings(settings, str(recipe.yaml))
        self.knobs = self._check.knobs
        self._written = frozenset(flat(settings))
        self._of_groups: dict[tuple[str, ...], DictConfig] = {}
        self._needed: dict[tuple[str, ...], dict[str, str]] = {}

    def compose(self, texts: Sequence[str]) -> Composed:
        """One configuration; values may still be missing or interpolations.

        Args:
            texts: ``key=value``, one value each; see :func:`compose`.

        Raises:
            UserError: one sentence that names the override or file at fault.
        """
        tasks = self.groups.get("task", ([], ""))[0]
        overrides = parse(list(words_by_key(_with_task(texts, tasks)).values()))
        for override in overrides:
            self._check.override(override)
        changes = {override.get_key_element(): normalised(override) for override in overrides}
        node = copy.deepcopy(self._composed_by_hydra(changes))
        for override in overrides:
            if override.get_key_element() not in self.groups:
                OmegaConf.update(node, override.get_key_element(), override.value(), merge=False)
        return Composed(node, changes, self._written)

    def job(self, texts: Sequence[str]) -> Job:
        """One job, without the texts that change nothing.

        Args:
            texts: ``key=value``, one value each.

        Raises:
            UserError: as :func:`resolved`.
        """
        words = words_by_key(texts)
        seed = [words.pop("seed")] if "seed" in words else []
        composed = self.compose([*words.values(), *seed])
        config = composed.config()
        validate(config)
        _refuse_unread(config, composed.changes)
        # Most jobs of a sweep differ in their seed alone, which other settings seldom refer to.
        unresolved = str(OmegaConf.to_container(composed.node))
        known = (*words.values(), *(seed if re.search(r"\$\{\.*seed\}", unresolved) else []))
        if known not in self._needed:
            self._needed[known] = self._without_idle(words, seed, asdict(config))
        needed = self._needed[known]
        values = flat(asdict(config), keep_empty=True)
        changes = {
            key: text if key in self.groups else f"{key}={default_text(values[key])}"
            for key, text in sorted(needed.items())
        }
        if seed:
            changes["seed"] = f"seed={config.seed}"
        return Job(config, changes, (*needed.values(), *seed))

    def _composed_by_hydra(self, changes: dict[str, str]) -> DictConfig:
        choices = tuple(text for key, text in changes.items() if key in self.groups)
        if choices in self._of_groups:
            return self._of_groups[choices]
        chosen = {group: default for group, (_, default) in self.groups.items()}
        chosen |= {choice.partition("=")[0]: choice.partition("=")[2] for choice in choices}
        for group, choice in chosen.items():
            own = self.recipe.yaml.parent / group / f"{choice}.yaml"
            if own.is_file():
                load_yaml(own)
        ConfigStore.instance().store(name=SCHEMA, node=self.schema)
        folder = str(shipped_conf()).replace("'", "\\'")
        search = f"hydra.searchpath=['file://{folder}']"
        file = self.recipe.yaml
        try:
            with initialize_config_dir(config_dir=str(file.parent), version_base="1.3"):
                node = hydra_compose(file.name, [*choices, search])
        except (HydraException, OmegaConfBaseException) as error:
            cause = error.__cause__ if isinstance(error.__cause__, Exception) else error
            raise UserError(f"{file} cannot be composed: {first_line(cause)}.") from error
        self._of_groups[choices] = node
        return node

    def _without_idle(
        self, words: dict[str, str], seed: list[str], values: dict[str, Any]
    ) -> dict[str, str]:
        """``words`` without those whose absence changes none of ``values``, except the task's."""
        task = "task" if "task" in words else "task.env_id"
        for key in sorted(words.keys() - {task}):
            rest = {other: text for other, text in words.items() if other != key}
            try:
                same = asdict(self.compose([*rest.values(), *seed]).config()) == values
            except UserError:  # A mandatory value.
                continue
            if same:
                words = rest
        return words


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
        >>> from giril_rl.config.recipes import find
        >>> composed = compose(find("gail"), RunConfig, ["task.env_id=Pendulum-v1", "steps=1000"])
        >>> composed.config().task.name, composed.config().steps
        ('Pendulum-v1', 1000)
    """
    return Composer(recipe, config).compose(texts)


def resolved(recipe: Recipe, config: type[Any], texts: Sequence[str]) -> tuple[Any, dict[str, str]]:
    """The validated ``Config`` of one job and the user's changes, see :class:`Composed`.

    Raises:
        UserError: as :func:`compose`, and for values that
            :func:`~giril_rl.config.validation.validate` refuses.
    """
    composed = compose(recipe, config, texts)
    built = composed.config()
    validate(built)
    _refuse_unread(built, composed.changes)
    return built, composed.changes


def _refuse_unread(config: Any, changes: Mapping[str, str]) -> None:
    """Refuses the user's settings of the algorithm that does not run."""
    if not isinstance(config, RunConfig):
        return
    idle = idle_algorithm(config.algorithm)
    for key, text in changes.items():
        if key.startswith(f"{idle}."):
            raise UserError(
                f"{text} has no effect with algorithm={config.algorithm}: leave it out, or set "
                f"algorithm={idle}."
            )


def groups(recipe: Recipe) -> dict[str, tuple[list[str], str]]:
    """A recipe's config groups, each with all its choices and the default one.

    The YAML's defaults list names a group as ``group: choice``. Its choices are the files in the
    folder of that name, beside the YAML and among the shipped settings.

    Examples:
        >>> from giril_rl.config.recipes import find
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


def _load_settings(recipe: Recipe) -> DictConfig:
    loaded = load_yaml(recipe.yaml)
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
    """Whether an entry is ``group: choice``, or ``group: null``.

    Paths, packages and Hydra's own groups are not.
    """
    if not isinstance(entry, dict) or len(entry) != 1 or "hydra" in entry:
        return False
    ((group, choice),) = entry.items()
    return (
        isinstance(group, str)
        and _GROUP.fullmatch(group) is not None
        and (choice is None or (isinstance(choice, str) and _CHOICE.fullmatch(choice) is not None))
    )
