"""The runs of a study, all composed and checked before the first one starts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from giril_rl.config.compose import Composer
from giril_rl.config.imports import check_found, modules_of, named_modules
from giril_rl.config.overrides import parse, sweep
from giril_rl.config.recipes import Recipe, config_class, find
from giril_rl.config.schema import ExpertRunConfig
from giril_rl.errors import UserError
from giril_rl.experiments.study.spec import Group, Spec, override_text
from giril_rl.files.disk import read_json
from giril_rl.runs.identity import check_sources, config_hash, is_scored_as, out_folder, sources

_STUDYS_OWN = ("out", "root")


@dataclass(frozen=True)
class StudyRun:
    """One run of a study: the words for ``giril run``, and the folder of the run.

    Attributes:
        label: its group's label.
        recipe: the recipe.
        words: its ``key=value`` texts, less those that change nothing.
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
        """The run's folder relative to the root, unique among the runs."""
        return self.folder.relative_to(self.root).as_posix()

    @property
    def command(self) -> list[str]:
        """The words after ``giril`` that make this run."""
        root = override_text("root", str(self.root))
        return ["run", self.recipe.word, *self.words, root]

    @property
    def finished(self) -> bool:
        """Whether the run has a result, with the scores of the episodes that are asked for."""
        return self.has_result and is_scored_as(self.folder, self.config.eval)

    @property
    def has_result(self) -> bool:
        """Whether the run has a result."""
        return (self.folder / "result.json").exists()

    @property
    def goes_first(self) -> bool:
        """Whether other runs wait for this one, because it is an expert that they record."""
        return isinstance(self.config, ExpertRunConfig)


class Planner:
    """Composes and checks the runs of a study.

    Args:
        root: the folder that all runs are in.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self._composers: dict[str, Composer] = {}

    def plan(self, spec: Spec, changes: Sequence[str] = ()) -> list[StudyRun]:
        """All runs of ``spec``, those of the lowest seed first.

        A study that is cut short then has a few seeds of every row instead of every seed of a few.

        Args:
            spec: the study.
            changes: ``key=value`` texts that replace every group's own, where its recipe has that
                knob; ``steps`` is not for a ``player``, nor for cloning.

        Raises:
            UserError: in one sentence, naming the group, for an unknown recipe or key, a wrong type
                or value, or two runs that are the same.
        """
        runs: dict[str, StudyRun] = {}
        composers = []
        for group in spec.groups:
            with _naming(spec, group):
                composers += [self._composer(word) for word in group.recipes]
        # Choices such as the task, and what no recipe has: that is left in, to be refused.
        shared = [text for text in changes if not any(_key(text) in c.knobs for c in composers)]
        for group in spec.groups:
            for word in group.recipes:
                with _naming(spec, group):
                    found = self._runs(group, self._composer(word), changes, shared)
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

    def _composer(self, word: str) -> Composer:
        if word not in self._composers:
            recipe = find(word)
            self._composers[word] = Composer(recipe, config_class(recipe))
        return self._composers[word]

    def _runs(
        self, group: Group, composer: Composer, changes: Sequence[str], shared: Sequence[str]
    ) -> list[StudyRun]:
        changes = [text for text in changes if text in shared or _key(text) in composer.knobs]
        # Another budget would make the player nobody's expert; cloning takes no steps.
        if group.player or "bc.steps" in composer.knobs:
            changes = [text for text in changes if _key(text) != "steps"]
        own = [_key(text) for text in changes]
        for key in [*group.knobs, *own]:
            if key in _STUDYS_OWN:
                raise UserError(
                    f"{key} is not a knob of a study's runs: they are named by themselves, below "
                    "the root= of the study."
                )
        lists = {key for key, knob in composer.knobs.items() if knob.is_list}
        texts = [
            override_text(key, value, is_list=key in lists)
            for key, value in group.knobs.items()
            if key not in own
        ]
        return [self._run(group.label, composer, words) for words in sweep([*texts, *changes])]

    def _run(self, label: str, composer: Composer, texts: Sequence[str]) -> StudyRun:
        job = composer.job(texts)
        config = replace(job.config, root=str(self.root))
        folder = out_folder(composer.recipe.name, config, job.changes)
        return StudyRun(label, composer.recipe, job.words, config, folder, self.root)

    def _check_modules(self, spec: Spec, run: StudyRun, changes: Sequence[str]) -> None:
        """Refuses a module that only the study's file names, or that cannot be found.

        Anybody may have written the file. Modules that the command line names are imported, and so
        are those of a recipe's own settings, which is a program in any case.
        """
        modules = modules_of(run.config)
        if not modules:
            return
        known = []
        for texts in sweep(changes):
            given = {override.get_key_element(): override.value() for override in parse(texts)}
            known += named_modules(given.get("task.env_id"), given.get("imports"))
        composer = self._composer(run.recipe.word)
        choices = [text for text in run.words if _key(text) in composer.groups]
        own: Any = OmegaConf.to_container(composer.compose(choices).node, resolve=False)
        known += named_modules(own["task"]["env_id"], own["imports"])
        for module in modules:
            if module not in known:
                raise UserError(
                    f"{spec.name} names the module {module}, and a study's file alone imports "
                    f"nothing: if you trust it, add imports=[{module}] to the command."
                )
        check_found(modules, *run.recipe.folders)


def _key(text: str) -> str:
    return text.partition("=")[0]


@contextmanager
def _naming(spec: Spec, group: Group) -> Iterator[None]:
    """Names the group in a refusal."""
    try:
        yield
    except UserError as error:
        raise UserError(f"{spec.name}, group {group.label!r}: {error}") from None


def _twice(spec: Spec, one: StudyRun, other: StudyRun) -> str:
    groups = f"groups {one.label!r} and {other.label!r} both ask for"
    if one.label == other.label:
        groups = f"group {one.label!r} asks twice for"
    return f"{spec.name}: {groups} the run {one.name}: leave it out once."


def _check_finished(run: StudyRun) -> None:
    """Refuses a folder whose run was made with other settings or by other code."""
    check_sources(run.folder, sources(run.recipe, modules_of(run.config)))
    if run.has_result:
        made = read_json(run.folder / "result.json").get("config_hash")
        if made is not None and made != config_hash(run.config):
            raise UserError(
                f"{run.folder} holds a finished run with other settings than this version of "
                f"{run.recipe.name} has: move it away, or choose another root=."
            )
