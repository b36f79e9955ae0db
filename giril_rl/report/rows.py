"""Runs that differ in their seed alone, as one row of a table."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from giril_rl.report.ablations import ABLATION_KEYS
from giril_rl.report.paper import paper_figure
from giril_rl.report.runs import RunRecord
from giril_rl.report.settings import (
    Changes,
    changes_of,
    method_of,
    shared_changes,
    split_task,
    uses_profile,
)
from giril_rl.report.statistics import Estimate, mean_and_iqm
from giril_rl.report.style import CONTROL, method_name, rank


@dataclass
class Row:
    """One method with one setting and budget on one task.

    Attributes:
        method: as ``result.json`` names it.
        profile: None where it makes no difference.
        changes: settings that differ from the recipe's own, less those of the whole panel.
        steps: the budget that the runs were given.
        runs: its runs, by seed.
    """

    method: str
    profile: str | None
    changes: Changes
    steps: int
    runs: list[RunRecord] = field(default_factory=list)

    @property
    def name(self) -> str:
        """The method as tables name it."""
        return method_name(self.method, self.profile)

    @property
    def is_control(self) -> bool:
        """Whether nothing of the row was learned from a demonstration's actions."""
        return self.method.startswith(CONTROL)

    @property
    def settings(self) -> str:
        """The changes as overrides, empty where there are none."""
        return " ".join(f"{key}={value}" for key, value in self.changes)

    @property
    def results(self) -> list[dict[str, Any]]:
        """The runs' results."""
        return [run.result for run in self.runs if run.result is not None]

    @property
    def seeds(self) -> list[int]:
        """The runs' seeds."""
        return [run.seed for run in self.runs]

    @property
    def scores(self) -> list[float]:
        """Each run's mean return, of the policy as trained."""
        return [float(result["return_mean"]) for result in self.results]

    @property
    def modes(self) -> list[float]:
        """Each run's mean return when the policy plays its mode; empty where a run has none."""
        found = [result.get("deterministic") for result in self.results]
        return [float(mode["return_mean"]) for mode in found if mode] if all(found) else []

    @property
    def mode_mean(self) -> float | None:
        """Mean of :attr:`modes`, None where there are none."""
        return _mean(self.modes)

    @property
    def trained_steps(self) -> list[int]:
        """Environment steps that the runs took: fewer than the budget for an early stop or BC."""
        return sorted({int(result["env_steps"]) for result in self.results})

    @property
    def life_length(self) -> float | None:
        """Mean over runs of the steps that a life lasts; None for tasks without lives."""
        return _mean([result.get("life_length_mean") for result in self.results])

    @property
    def speed(self) -> float | None:
        """Mean over runs of the environment steps a second that training took."""
        if not self.is_trained:
            return None
        return _mean([result.get("steps_per_second") for result in self.results])

    @property
    def is_trained(self) -> bool:
        """Whether it took steps in the environment: cloning and a random policy do not."""
        return any(self.trained_steps)

    @cached_property
    def estimates(self) -> tuple[Estimate, Estimate]:
        """Mean and interquartile mean over seeds."""
        return mean_and_iqm(self.scores)

    @property
    def order(self) -> tuple[Any, ...]:
        """Where the row stands in a table."""
        # `released` is the default and comes first.
        changes = [(key, _numeric(value)) for key, value in self.changes]
        return (*rank(self.method), self.profile != "released", self.steps, changes)


def _mean(values: Sequence[float | None]) -> float | None:
    """None where a value is missing."""
    found = [value for value in values if value is not None]
    return sum(found) / len(found) if found and len(found) == len(values) else None


def _numeric(text: str) -> tuple[float, str]:
    """Sorts numbers by their size and before words."""
    try:
        return float(text), ""
    except ValueError:
        return float("inf"), text


def longest(rows: Iterable[Row]) -> list[Row]:
    """Of each method but the expert, the row with the largest budget.

    Examples:
        >>> [row.steps for row in longest([Row("bc", None, (), 10), Row("bc", None, (), 20)])]
        [20]
    """
    found: dict[str, Row] = {}
    for row in rows:
        if row.method != "expert" and (row.name not in found or row.steps > found[row.name].steps):
            found[row.name] = row
    return list(found.values())


@dataclass
class Panel:
    """All rows of one task.

    Attributes:
        task: the task's name.
        changes: what makes the task another one, such as a fixed horizon.
        shared: further changes that all of its runs have.
        rows: the rows in order.
        repeats: runs that repeat a row's seed and count nowhere.
    """

    task: str
    changes: Changes
    shared: Changes
    rows: list[Row]
    repeats: list[RunRecord]

    @property
    def title(self) -> str:
        """The task, with what makes it another one.

        Examples:
            >>> Panel("t", (("task.horizon", "fixed"),), (), [], []).title
            't, task.horizon=fixed'
        """
        return ", ".join([self.task, *(f"{key}={value}" for key, value in self.changes)])

    @property
    def main(self) -> list[Row]:
        """The rows with the recipes' own settings."""
        return [row for row in self.rows if not row.changes]

    @property
    def demonstration(self) -> str:
        """What the demonstration is called: one life's score is not to be read as a game's."""
        runs = [run for row in self.rows for run in row.runs]
        lives = {run.config["demo.lives"] for run in runs if "demo.lives" in run.config}
        atari = any(run.is_atari for run in runs)
        return "demonstration of one life" if atari and lives == {"first"} else "demonstration"

    def reference(self, who: str) -> float | None:
        """Mean return of the ``expert`` or the ``demo`` that most runs have; main rows first."""
        key = f"{who}_return_mean"
        for rows in (self.main, self.rows):
            found = [r[key] for row in rows for r in row.results if r.get(key) is not None]
            if found:
                return float(max(found, key=found.count))
        return None

    def best_control(self, row: Row) -> Row | None:
        """The control with the highest mean at a row's budget, with its recipe's own settings.

        A row that took no environment steps is compared with the controls of the largest budget.
        None where no control was trained at that budget: to be better than a random policy says
        nothing.
        """
        controls = [other for other in self.main if other.is_control]
        most = max((other.steps for other in controls), default=0)
        steps = row.steps if row.is_trained else most
        fair = [other for other in controls if other.steps == steps and other.is_trained]
        fair += [other for other in controls if fair and not other.is_trained]
        return max(fair, key=lambda other: other.estimates[0].value, default=None)


def panels_of(runs: Sequence[RunRecord]) -> list[Panel]:
    """Groups finished runs into rows, and rows into panels by their task."""
    changes = changes_of(runs)
    tasks: dict[tuple[str, Changes], list[RunRecord]] = {}
    for run in runs:
        # An expert is trained on the task's own horizon, and belongs to it.
        key = (str(run.config["task.name"]), split_task(changes[run.name])[0])
        tasks.setdefault(key, []).append(run)
    # The paper's tasks come first.
    order = sorted(tasks, key=lambda key: (not paper_figure("results", key[0], "giril"), *key))
    return [_panel(*key, tasks[key], changes) for key in order]


def _panel(
    task: str, of_task: Changes, runs: Sequence[RunRecord], changes: dict[str, Changes]
) -> Panel:
    others = {run.name: split_task(changes[run.name])[1] for run in runs}
    shared = shared_changes(runs, others, ABLATION_KEYS)
    rows: dict[tuple[Any, ...], Row] = {}
    repeats = []
    for run in runs:
        own = tuple(change for change in others[run.name] if change not in shared)
        profile = str(run.config.get("profile")) if uses_profile(run) else None
        key = (method_of(run), profile, own, run.steps)
        row = rows.setdefault(key, Row(*key))
        if run.seed in row.seeds:
            repeats.append(run)
        else:
            row.runs.append(run)
            row.runs.sort(key=lambda run: run.seed)
    return Panel(task, of_task, shared, sorted(rows.values(), key=lambda row: row.order), repeats)
