"""From a study's file to the list of its runs, each composed and checked before any is started."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from giril_rl.configs import ExpertRunConfig
from giril_rl.errors import UserError
from giril_rl.naming import config_hash, out_folder
from giril_rl.recipes import Recipe
from giril_rl.study.spec import Group, Spec, override_text

_STUDYS_OWN = ("out", "root")


@dataclass(frozen=True)
class StudyRun:
    """One run of a study: what ``giril run`` is called with and where it leaves its folder.

    Attributes:
        label: its group's label.
        recipe: the recipe.
        words: its ``key=value`` texts, without those that change nothing.
        config: the composed and validated configuration.
        folder: the run's folder.
        root: the folder that all runs of the study are in.
    """

    label: str
    recipe: Recipe
    words: tuple[str, ...]
    config: Any
    folder: Path
    root: Path

    @property
    def name(self) -> str:
        """The run's folder as seen from the root, which tells it from all other runs."""
        return self.folder.relative_to(self.root).as_posix()

    @property
    def command(self) -> list[str]:
        """The words after ``giril`` that make this run."""
        root = override_text("root", str(self.root))
        return ["run", self.recipe.word, *self.words, root]

    @property
    def finished(self) -> bool:
        """Whether the run has its result."""
        return (self.folder / "result.json").exists()

    @property
    def goes_first(self) -> bool:
        """Whether other runs may wait for this one: an expert, which they record or train on."""
        return isinstance(self.config, ExpertRunConfig)


class Planner:
    """Composes and checks the runs of a study.

    Args:
        root: the folder that all runs are in.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self._schemas: dict[str, tuple[Recipe, type[Any]]] = {}
        self._resolutions: dict[tuple[str, ...], tuple[Any, dict[str, str]]] = {}
        self._composed: dict[tuple[str, ...], tuple[Any, dict[str, str], tuple[str, ...]]] = {}

    def plan(self, spec: Spec, changes: Sequence[str] = ()) -> list[StudyRun]:
        """All runs of ``spec``, those of the lowest seed first.

        A study that is cut short then has a few seeds of every row, not every seed of a few rows.

        Args:
            spec: the study.
            changes: ``key=value`` texts that take the place of every group's own, where its recipe
                has that knob; ``steps`` not of a ``player``, nor of cloning.

        Raises:
            UserError: in one sentence, naming the group, for an unknown recipe or key, a wrong type
                or value, or two runs that are the same.
        """
        runs: dict[str, StudyRun] = {}
        schemas = self._all_schemas(spec)
        shared = [text for text in changes if not any(_has(s, text) for s in schemas)]
        for group in spec.groups:
            for word in group.recipes:
                with _naming(spec, group):
                    found = self._runs(group, word, changes, shared)
                for run in found:
                    same = runs.setdefault(f"{run.recipe.name} {config_hash(run.config)}", run)
                    if same is not run:
                        raise UserError(_twice(spec, same, run))
        places: dict[Path, StudyRun] = {}
        for run in runs.values():
            if places.setdefault(run.folder, run) is not run:
                raise UserError(
                    f"{spec.name}: two recipes of the name {run.recipe.name} would share the "
                    f"folder {run.folder}: rename one of their files."
                )
            _check_finished(run)
        return sorted(runs.values(), key=lambda run: run.config.seed)

    def _all_schemas(self, spec: Spec) -> list[type[Any]]:
        found = []
        for group in spec.groups:
            with _naming(spec, group):
                found += [self._recipe(word)[1] for word in group.recipes]
        return found

    def _runs(
        self, group: Group, word: str, changes: Sequence[str], shared: Sequence[str]
    ) -> list[StudyRun]:
        from giril_rl.overrides import sweep

        recipe, schema = self._recipe(word)
        # What no recipe has is left in, to be refused; so are choices such as the task.
        changes = [text for text in changes if text in shared or _has(schema, text)]
        kept: tuple[str, ...] = ()
        if group.player or _clones(schema):  # With another budget it would be nobody's expert.
            kept = ("steps=",)
        changes = [text for text in changes if not text.startswith(kept)]
        own = [text.partition("=")[0] for text in changes]
        texts = [
            override_text(key, value, is_list=_holds_list(schema, key))
            for key, value in group.knobs.items()
            if key not in own
        ]
        for key in [*group.knobs, *own]:
            if key in _STUDYS_OWN:
                raise UserError(
                    f"{key} is not a knob of a study's runs: they are named by themselves, below "
                    "the root= of the study."
                )
        return [self._run(group.label, recipe, job) for job in sweep([*texts, *changes])]

    def _recipe(self, word: str) -> tuple[Recipe, type[Any]]:
        from giril_rl.recipe_config import config_class
        from giril_rl.recipes import find

        if word not in self._schemas:
            recipe = find(word)
            self._schemas[word] = recipe, config_class(recipe)
        return self._schemas[word]

    def _run(self, label: str, recipe: Recipe, job: Sequence[str]) -> StudyRun:
        # Composing takes a tenth of a second, and most runs differ in their seed alone.
        seeds = [text for text in job if text.startswith("seed=")]
        seed = seeds[0].partition("=")[2] if seeds else ""
        if seed.isdecimal():
            rest = tuple(text for text in job if text not in seeds)
            config, changes, words = self._settled(recipe, rest)
            config, words = replace(config, seed=int(seed)), (*words, f"seed={int(seed)}")
        else:
            config, changes, words = self._settled(recipe, tuple(job))
        config = replace(config, root=str(self.root))
        folder = out_folder(recipe.name, config, changes)
        return StudyRun(label, recipe, words, config, folder, self.root)

    def _settled(
        self, recipe: Recipe, words: tuple[str, ...]
    ) -> tuple[Any, dict[str, str], tuple[str, ...]]:
        """The configuration, and the changes and words that make it.

        A knob that is set to what it is anyway is left out, so that a run has one folder however it
        was asked for, and studies share it.
        """
        known = (recipe.word, *words)
        if known not in self._composed:
            config, changes = self._resolved(recipe, words)
            task = tuple(word for word in words if word.partition("=")[0].startswith("task"))
            base, _ = self._resolved(recipe, task)
            kept = tuple(word for word in words if word in task or _differs(word, config, base))
            if kept != words:
                shorter, fewer = self._resolved(recipe, kept)
                # A default may follow another knob: then all of them are needed.
                if asdict(shorter) == asdict(config):
                    changes, words = fewer, kept
            self._composed[known] = config, changes, words
        return self._composed[known]

    def _resolved(self, recipe: Recipe, words: Sequence[str]) -> tuple[Any, dict[str, str]]:
        from giril_rl.compose import resolved

        known = (recipe.word, *words)
        if known not in self._resolutions:
            schema = self._recipe(recipe.word)[1]
            self._resolutions[known] = resolved(recipe, schema, words)
        return self._resolutions[known]


@contextmanager
def _naming(spec: Spec, group: Group) -> Iterator[None]:
    """Says in a refusal which group it is about."""
    try:
        yield
    except UserError as error:
        raise UserError(f"{spec.name}, group {group.label!r}: {error}") from None


def _differs(word: str, config: Any, base: Any) -> bool:
    for name in word.partition("=")[0].split("."):
        if not hasattr(config, name):
            return True
        config, base = getattr(config, name), getattr(base, name)
    return bool(config != base)


def _holds_list(schema: type[Any], key: str) -> bool:
    from giril_rl.schema import leaves

    return any(leaf.key == key and "list" in leaf.needed for leaf in leaves(schema))


def _has(schema: type[Any], text: str) -> bool:
    from giril_rl.schema import leaves

    return any(leaf.key == text.partition("=")[0] for leaf in leaves(schema))


def _clones(schema: type[Any]) -> bool:
    from giril_rl.schema import leaves

    return any(leaf.key == "bc.steps" for leaf in leaves(schema))


def _twice(spec: Spec, one: StudyRun, other: StudyRun) -> str:
    groups = f"groups {one.label!r} and {other.label!r} both ask for"
    if one.label == other.label:
        groups = f"group {one.label!r} asks twice for"
    return f"{spec.name}: {groups} the run {one.name}: leave it out once."


def _check_finished(run: StudyRun) -> None:
    """Refuses a finished run in the way that was made with other settings."""
    from giril_rl.files import read_json

    if run.finished:
        made = read_json(run.folder / "result.json").get("config_hash")
        if made is not None and made != config_hash(run.config):
            raise UserError(
                f"{run.folder} holds a finished run with other settings than this version of "
                f"{run.recipe.name} has: move it away, or choose another root=."
            )
