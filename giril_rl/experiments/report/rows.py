"""Groups runs that differ in the seed alone into rows, and the rows of a task into a panel."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

from giril_rl.experiments.report.entries import (
    OWN,
    PLAYER,
    TRUE_REWARD,
    entry,
    is_own,
    order,
)
from giril_rl.experiments.report.reading import RunRecord
from giril_rl.experiments.report.settings import (
    Changes,
    changes_of,
    profile_of,
    shared_changes,
    split_task,
)
from giril_rl.experiments.report.statistics import Estimate, mean_and_iqm
from giril_rl.rewards.method import Method
from giril_rl.training.baselines import RANDOM
from giril_rl.training.result import score_over_demonstration

STYLES = ("-", "--", "-.", ":")
DOTS = ((0, (1, 1)), (0, (5, 1.5, 1, 1.5)), (0, (1, 2.5)), (0, (5, 1.5, 1, 1.5, 1, 1.5)))
"""The line styles of PPO's rows beside those of SAC, in the order of ``STYLES``."""


class Look(NamedTuple):
    """How a line is drawn."""

    color: str
    linestyle: Any


@dataclass(eq=False)
class Row:
    """One method with one setting and budget on one task.

    Attributes:
        method: see :attr:`giril_rl.experiments.report.reading.RunRecord.method`.
        profile: None where it makes no difference.
        changes: settings that differ from the recipe's own, without those that the panel shares.
        steps: the budget of environment steps.
        runs: its runs, by seed.
        number: the place of your own recipe among all of them in the report.
        algorithm: "ppo" or "sac"; None without reinforcement learning.
        beside_sac: whether a run of its panel has SAC, so that names tell the algorithm.
    """

    method: str
    profile: str | None
    changes: Changes
    steps: int
    runs: list[RunRecord] = field(default_factory=list)
    number: int = 0
    algorithm: str | None = None
    beside_sac: bool = False

    @property
    def about(self) -> Method:
        """Its method's entry."""
        return entry(self.method, self.number)

    @property
    def name(self) -> str:
        """The method as tables name it.

        Examples:
            >>> Row("giril", "paper", (), 10).name, Row("control:copy", "released", (), 10).name
            ('GIRIL (paper)', 'control: copy')
            >>> Row("giril", "paper", (), 10, algorithm="ppo", beside_sac=True).name
            'GIRIL (paper, PPO)'
            >>> Row("expert:whole_budget", None, (), 10, algorithm="sac", beside_sac=True).name
            'SAC on the true reward'
        """
        algorithm = (self.algorithm or "").upper() if self.beside_sac else ""
        if self.method == TRUE_REWARD and algorithm:
            return f"{algorithm} on the true reward"
        return _in_brackets(self.about.label, self._shown_profile, algorithm)

    @property
    def name_of_both(self) -> str:
        """The method as a table names it that has a column for each algorithm.

        Examples:
            >>> Row("giril", "paper", (), 10, algorithm="ppo", beside_sac=True).name_of_both
            'GIRIL (paper)'
        """
        if self.method == TRUE_REWARD:
            return "the true reward"
        return _in_brackets(self.about.label, self._shown_profile)

    @property
    def _shown_profile(self) -> str:
        shown = self.profile and not (self.is_control and self.profile == "released")
        return str(self.profile) if shown else ""

    @property
    def is_control(self) -> bool:
        """Whether its method is a control."""
        return self.about.kind == "control"

    @property
    def is_learned(self) -> bool:
        """Whether its method imitates: neither a control nor a policy trained on true rewards."""
        return not self.is_control and self.method not in (PLAYER, TRUE_REWARD)

    @property
    def look(self) -> Look:
        """How it is drawn: the profile "paper" and the seventh recipe of your own are dashed.

        PPO's rows are dotted where others have SAC.
        """
        turn = 2 * (self.number // len(OWN)) + (self.profile == "paper")
        styles = DOTS if self.beside_sac and self.algorithm == "ppo" else STYLES
        return Look(self.about.colour, styles[turn % 4])

    @property
    def kind(self) -> tuple[str, str | None, str | None]:
        """What its runs share whatever their budget and settings."""
        return self.method, self.profile, self.algorithm

    @property
    def settings(self) -> str:
        """The changes as overrides, empty where there are none."""
        return " ".join(f"{key}={value}" for key, value in self.changes)

    @property
    def seeds(self) -> list[int]:
        """The runs' seeds."""
        return [run.seed for run in self.runs]

    @property
    def scores(self) -> list[float]:
        """Each run's mean return, of the policy as trained."""
        return [run.score for run in self.runs]

    @property
    def modes(self) -> list[float]:
        """Each run's mean return with the policy's most likely actions; empty if a run has none."""
        found = [run.mode for run in self.runs]
        scores = [score for score in found if score is not None]
        return scores if len(scores) == len(found) else []

    @property
    def trained_steps(self) -> list[int]:
        """Environment steps that runs took: fewer than the budget if one stopped early."""
        return sorted({int(run.result["env_steps"]) for run in self.runs})

    @property
    def is_trained(self) -> bool:
        """Whether it took environment steps, unlike cloning or a random policy."""
        return any(self.trained_steps)

    def mean_of(self, key: str) -> float | None:
        """Mean over runs of an entry of their results; None if a run lacks it."""
        return mean([run.result.get(key) for run in self.runs])

    @cached_property
    def estimates(self) -> tuple[Estimate, Estimate]:
        """Mean and interquartile mean of the scores."""
        return mean_and_iqm(self.scores)

    @property
    def order(self) -> tuple[Any, ...]:
        """Sorts the rows of a table."""
        changes = [(key, _numeric(value)) for key, value in self.changes]
        profile = self.profile != "released"
        return (*order(self.method), profile, self.steps, self.algorithm or "", changes)


def _in_brackets(label: str, *words: str) -> str:
    shown = ", ".join(filter(None, words))
    return f"{label} ({shown})" if shown else label


def mean(values: Sequence[float | None]) -> float | None:
    """The mean; None if there is no value or one is missing.

    Examples:
        >>> mean([1.0, 2.0]), mean([1.0, None]), mean([])
        (1.5, None, None)
    """
    found = [value for value in values if value is not None]
    return sum(found) / len(found) if found and len(found) == len(values) else None


def _numeric(text: str) -> tuple[float, str]:
    """Sorts numbers by size, and before words."""
    try:
        return float(text), ""
    except ValueError:
        return float("inf"), text


@dataclass(eq=False)
class Panel:
    """All rows of one task.

    Scores are normalised between those of a random policy, 0, and of the player that made the
    demonstration, 1. The scale is linear, so that scores may be negative or above 1.

    Attributes:
        task: the task's name.
        changes: settings that make the task another one, such as a fixed horizon.
        shared: further changes that all of its runs have.
        rows: the rows in order.
        repeats: runs that repeat a row's seed and do not count.
    """

    task: str
    changes: Changes
    shared: Changes
    rows: list[Row]
    repeats: list[RunRecord]

    @property
    def title(self) -> str:
        """The task with its changes.

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
    def runs(self) -> list[RunRecord]:
        """The runs of all rows."""
        return [run for row in self.rows for run in row.runs]

    @property
    def has_sac(self) -> bool:
        """Whether a policy of it was trained by SAC."""
        return any(row.beside_sac for row in self.rows)

    @property
    def demonstration(self) -> str:
        """What to call the demonstration: the score of one life is not that of a whole game."""
        lives = {run.config["demo.lives"] for run in self.runs if "demo.lives" in run.config}
        counted = any(run.family.has_lives for run in self.runs)
        return "demonstration of one life" if counted and lives == {"first"} else "demonstration"

    def references(self, who: str) -> list[float]:
        """Mean return of each seed's ``expert`` or ``demo``, of the main rows if they have any.

        One value if it is the same for all seeds.
        """
        key = f"{who}_return_mean"
        found = list((self._main_by_seed(key) or by_seed(self.runs, key)).values())
        return found[:1] if len(set(found)) == 1 else found

    def _main_by_seed(self, key: str) -> dict[int, float]:
        return by_seed([run for row in self.main for run in row.runs], key)

    @cached_property
    def random(self) -> float | None:
        """Mean score of the random policy; None if there is no run of it."""
        return mean([score for row in self.rows if row.method == RANDOM for score in row.scores])

    @cached_property
    def _of_seeds(self) -> dict[str, dict[int, float]]:
        keys = ("expert_return_mean", "demo_return_mean")
        return {key: by_seed(self.runs, key) | self._main_by_seed(key) for key in keys}

    def _reference(self, run: RunRecord, key: str) -> float | None:
        """A run's own ``key``; that of its seed if the run has no demonstration."""
        if run.result.get(key) is not None:
            return float(run.result[key])
        return None if run.has_demonstration else self._of_seeds[key].get(run.seed)

    def player(self, run: RunRecord) -> float | None:
        """Score of a run's player; that of its seed if the run has no demonstration."""
        return self._reference(run, "expert_return_mean")

    def normalised_run(self, run: RunRecord) -> float | None:
        """A run's normalised score.

        None for the player itself, without a player or a random policy, and if the player does not
        score above the random policy.
        """
        low, high = self.random, self.player(run)
        if run.method == PLAYER or low is None or high is None or high <= low:
            return None
        return (run.score - low) / (high - low)

    def normalised(self, row: Row) -> list[float]:
        """The normalised scores of a row's runs; empty if one of them has none."""
        found = [self.normalised_run(run) for run in row.runs]
        scores = [score for score in found if score is not None]
        return scores if len(scores) == len(found) else []

    def over_demonstration_run(self, run: RunRecord) -> float | None:
        """A run's score divided by its demonstration's return, or by that of its seed.

        None for the player itself, and where the quotient would mislead, see
        :func:`giril_rl.training.result.score_over_demonstration`.
        """
        if run.method == PLAYER:
            return None
        return score_over_demonstration(run.score, self._reference(run, "demo_return_mean"))

    def over_demonstration(self, row: Row) -> list[float]:
        """The same of a row's runs; empty if one of them has none."""
        found = [self.over_demonstration_run(run) for run in row.runs]
        ratios = [ratio for ratio in found if ratio is not None]
        return ratios if len(ratios) == len(found) else []

    def best_control(self, row: Row) -> Row | None:
        """The control with the highest mean at a row's budget, with its recipe's own settings.

        A row that took no environment steps is compared at the controls' largest budget. None if no
        control was trained at that budget: a random policy alone is no comparison. With which
        algorithm it was trained does not matter.
        """
        most = max((other.steps for other in self.main if other.is_control), default=0)
        return self.best_control_at(row.steps if row.is_trained else most)

    def best_control_at(self, steps: int, algorithm: str | None = None) -> Row | None:
        """The best control at a budget, trained by ``algorithm`` if one is given."""
        controls = [other for other in self.main if other.is_control]
        fair = [other for other in controls if other.steps == steps and other.is_trained]
        fair = [other for other in fair if algorithm in (None, other.algorithm)]
        fair += [other for other in controls if fair and not other.is_trained]
        # Decides ties.
        fair.sort(key=lambda other: (not other.is_trained, other.method, other.algorithm or ""))
        return max(fair, key=lambda other: other.estimates[0].value, default=None)


def by_seed(runs: Iterable[RunRecord], key: str) -> dict[int, float]:
    """For each seed, the value of ``key`` that most results have."""
    found: dict[int, list[float]] = {}
    for run in runs:
        if run.result.get(key) is not None:
            found.setdefault(run.seed, []).append(float(run.result[key]))
    return {seed: max(each, key=each.count) for seed, each in sorted(found.items())}


def group(runs: Sequence[RunRecord], keep: frozenset[str]) -> list[Panel]:
    """Groups runs into rows and panels; the settings in ``keep`` make rows even if all agree."""
    changes = changes_of(runs)
    own = sorted({run.method for run in runs if is_own(run.method)})
    tasks: dict[tuple[str, Changes], list[RunRecord]] = {}
    # Cloning and experts know no `termination`: they join the runs that do, whatever its value.
    for run in sorted(runs, key=lambda run: "termination" not in run.config):
        of_task = split_task(changes[run.name])[0]
        if "termination" not in run.config:
            others = [place[1] for place in sorted(tasks) if place[0] == run.task]
            same = [o for o in others if of_task == tuple(c for c in o if c[0] != "termination")]
            of_task = next(iter(same), of_task)
        tasks.setdefault((run.task, of_task), []).append(run)
    return [_panel(*key, tasks[key], changes, own, keep) for key in sorted(tasks)]


def _panel(
    task: str,
    of_task: Changes,
    runs: Sequence[RunRecord],
    changes: dict[str, Changes],
    own: Sequence[str],
    keep: frozenset[str],
) -> Panel:
    others = {run.name: split_task(changes[run.name])[1] for run in runs}
    shared = shared_changes(runs, others, keep)
    rows: dict[tuple[Any, ...], Row] = {}
    repeats = []
    has_sac = any(run.algorithm == "sac" for run in runs)
    for run in runs:
        differing = tuple(change for change in others[run.name] if change not in shared)
        number = own.index(run.method) if run.method in own else 0
        key = (run.method, profile_of(run), differing, run.steps)
        row = Row(*key, number=number, algorithm=run.algorithm, beside_sac=has_sac)
        row = rows.setdefault((*key, run.algorithm), row)
        if run.seed in row.seeds:
            repeats.append(run)
        else:
            row.runs.append(run)
            row.runs.sort(key=lambda run: run.seed)
    return Panel(task, of_task, shared, sorted(rows.values(), key=lambda row: row.order), repeats)
