"""Runs that differ in their seed alone, as one row of a table."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from giril_rl.experiments.report.ablations import ABLATION_KEYS
from giril_rl.experiments.report.normalised import Scale, by_seed
from giril_rl.experiments.report.paper import paper_figure
from giril_rl.experiments.report.runs import RunRecord
from giril_rl.experiments.report.settings import (
    Changes,
    changes_of,
    method_of,
    profile_of,
    shared_changes,
    split_task,
)
from giril_rl.experiments.report.statistics import Estimate, mean_and_iqm
from giril_rl.experiments.report.style import (
    CONTROL,
    TRUE_REWARD,
    Look,
    is_own,
    look,
    method_name,
    rank,
)
from giril_rl.training.baselines import RANDOM


@dataclass
class Row:
    """One method with one setting and budget on one task.

    Attributes:
        method: as :func:`giril_rl.experiments.report.settings.method_of` names it.
        profile: None where it makes no difference.
        changes: settings that differ from the recipe's own, less those of the whole panel.
        steps: the budget that the runs were given.
        runs: its runs, by seed.
        number: of a recipe of the user's own, its place among all of them in the report.
    """

    method: str
    profile: str | None
    changes: Changes
    steps: int
    runs: list[RunRecord] = field(default_factory=list)
    number: int = 0

    @property
    def name(self) -> str:
        """The method as tables name it."""
        return method_name(self.method, self.profile)

    @property
    def is_control(self) -> bool:
        """Whether nothing of the row was learned from a demonstration's actions."""
        return self.method.startswith(CONTROL)

    @property
    def is_learned(self) -> bool:
        """Whether it is of a method that imitates: no control, and nothing on the true reward."""
        return not self.is_control and self.method not in ("expert", TRUE_REWARD)

    @property
    def look(self) -> Look:
        """How it is drawn."""
        return look(self.method, self.profile, self.number)

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
    found: dict[tuple[str, str | None], Row] = {}
    for row in rows:
        key = row.method, row.profile
        if row.method != "expert" and (key not in found or row.steps > found[key].steps):
            found[key] = row
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
        counted = any(run.family.has_lives for run in runs)
        return "demonstration of one life" if counted and lives == {"first"} else "demonstration"

    @cached_property
    def scale(self) -> Scale:
        """What scores are normalised by."""
        random = [score for row in self.rows if row.method == RANDOM for score in row.scores]
        every = [run for row in self.rows for run in row.runs]
        players = by_seed(every, "expert_return_mean") | self._main_by_seed("expert")
        return Scale(_mean(random), players)

    def references(self, who: str) -> list[float]:
        """Mean return of each seed's ``expert`` or ``demo``, of the main rows if they have any.

        One value where all seeds have the same.
        """
        found = list(self._main_by_seed(who).values())
        if not found:
            every = [run for row in self.rows for run in row.runs]
            found = list(by_seed(every, f"{who}_return_mean").values())
        return found[:1] if len(set(found)) == 1 else found

    def _main_by_seed(self, who: str) -> dict[int, float]:
        return by_seed([run for row in self.main for run in row.runs], f"{who}_return_mean")

    def reference(self, who: str) -> float | None:
        """Mean over seeds of :meth:`references`; None where there are none."""
        return _mean(self.references(who))

    def normalised(self, row: Row) -> list[float]:
        """A row's scores between a random policy's and each run's player's; empty without them."""
        return self.scale.of_runs(row.runs)

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
    own = sorted({method for run in runs if is_own(method := method_of(run))})
    tasks: dict[tuple[str, Changes], list[RunRecord]] = {}
    for run in runs:
        # An expert is trained on the task's own horizon, and belongs to it.
        key = (str(run.config["task.name"]), split_task(changes[run.name])[0])
        tasks.setdefault(key, []).append(run)
    # The paper's tasks come first.
    order = sorted(tasks, key=lambda key: (not paper_figure("results", key[0], "giril"), *key))
    return [_panel(*key, tasks[key], changes, own) for key in order]


def _panel(
    task: str,
    of_task: Changes,
    runs: Sequence[RunRecord],
    changes: dict[str, Changes],
    own: Sequence[str],
) -> Panel:
    others = {run.name: split_task(changes[run.name])[1] for run in runs}
    shared = shared_changes(runs, others, ABLATION_KEYS)
    rows: dict[tuple[Any, ...], Row] = {}
    repeats = []
    for run in runs:
        method = method_of(run)
        differing = tuple(change for change in others[run.name] if change not in shared)
        number = own.index(method) if method in own else 0
        key = (method, profile_of(run), differing, run.steps)
        row = rows.setdefault(key, Row(*key, number=number))
        if run.seed in row.seeds:
            repeats.append(run)
        else:
            row.runs.append(run)
            row.runs.sort(key=lambda run: run.seed)
    return Panel(task, of_task, shared, sorted(rows.values(), key=lambda row: row.order), repeats)
