"""From a study's file to the list of its runs, each composed and checked before any is started."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from giril_rl.config.compose import compose, groups
from giril_rl.config.imports import check_found, modules_of, named_modules
from giril_rl.config.jobs import Jobs
from giril_rl.config.overrides import parse, sweep
from giril_rl.config.recipe_files import Recipe
from giril_rl.config.schema import ExpertRunConfig
from giril_rl.errors import UserError
from giril_rl.experiments.study.spec import Group, Spec, override_text
from giril_rl.files.disk import read_json
from giril_rl.runs.identity import check_sources, config_hash, is_scored_as, out_folder, sources

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
        """Whether the run has its result, with the scores that are asked for."""
        return self.has_result and is_scored_as(self.folder, self.config.eval)

    @property
    def has_result(self) -> bool:
        """Whether the run has a result."""
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
        self._jobs = Jobs()

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
            self._check_modules(spec, run, changes)
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
        from giril_rl.config.recipe_config import config_class
        from giril_rl.config.recipe_files import find

        if word not in self._schemas:
            recipe = find(word)
            self._schemas[word] = recipe, config_class(recipe)
        return self._schemas[word]

    def _run(self, label: str, recipe: Recipe, texts: Sequence[str]) -> StudyRun:
        job = self._jobs.job(recipe, self._recipe(recipe.word)[1], texts)
        config = replace(job.config, root=str(self.root))
        folder = out_folder(recipe.name, config, job.changes)
        return StudyRun(label, recipe, job.words, config, folder, self.root)

    def _check_modules(self, spec: Spec, run: StudyRun, changes: Sequence[str]) -> None:
        """Refuses a module that the study's file alone names, or that cannot be found.

        Anybody may have written the file. What the command line names is imported, and so is what
        a recipe's own settings name, which is a program in any case.
        """
        modules = modules_of(run.config)
        if not modules:
            return
        known = []
        for texts in sweep(changes):
            given = {override.get_key_element(): override.value() for override in parse(texts)}
            known += named_modules(given.get("task.env_id"), given.get("imports"))
        choices = [text for text in run.words if text.partition("=")[0] in groups(run.recipe)]
        node = compose(run.recipe, self._recipe(run.recipe.word)[1], choices).node
        own: Any = OmegaConf.to_container(node, resolve=False)
        known += named_modules(own["task"]["env_id"], own["imports"])
        for module in modules:
            if module not in known:
                raise UserError(
                    f"{spec.name} names the module {module}, and a study's file alone imports "
                    f"nothing: if you trust it, add imports=[{module}] to the command."
                )
        check_found(modules, *run.recipe.folders)


@contextmanager
def _naming(spec: Spec, group: Group) -> Iterator[None]:
    """Says in a refusal which group it is about."""
    try:
        yield
    except UserError as error:
        raise UserError(f"{spec.name}, group {group.label!r}: {error}") from None


def _holds_list(schema: type[Any], key: str) -> bool:
    from giril_rl.config.leaves import leaves

    return any(leaf.key == key and "list" in leaf.needed for leaf in leaves(schema))


def _has(schema: type[Any], text: str) -> bool:
    from giril_rl.config.leaves import leaves

    return any(leaf.key == text.partition("=")[0] for leaf in leaves(schema))


def _clones(schema: type[Any]) -> bool:
    from giril_rl.config.leaves import leaves

    return any(leaf.key == "bc.steps" for leaf in leaves(schema))


def _twice(spec: Spec, one: StudyRun, other: StudyRun) -> str:
    groups = f"groups {one.label!r} and {other.label!r} both ask for"
    if one.label == other.label:
        groups = f"group {one.label!r} asks twice for"
    return f"{spec.name}: {groups} the run {one.name}: leave it out once."


def _check_finished(run: StudyRun) -> None:
    """Refuses a run in the way that was made with other settings or by other code."""
    check_sources(run.folder, sources(run.recipe, modules_of(run.config)))
    if run.has_result:
        made = read_json(run.folder / "result.json").get("config_hash")
        if made is not None and made != config_hash(run.config):
            raise UserError(
                f"{run.folder} holds a finished run with other settings than this version of "
                f"{run.recipe.name} has: move it away, or choose another root=."
            )
