"""The tables of a task: results, ablations and other settings, beside the paper's figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from giril_rl.experiments.report.entries import PLAYER
from giril_rl.experiments.report.reading import RunRecord
from giril_rl.experiments.report.rows import Panel, Row, group
from giril_rl.experiments.report.settings import Changes, text_of
from giril_rl.experiments.report.statistics import (
    Estimate,
    mean_and_iqm,
    probability_of_improvement,
)


@cache
def _paper() -> dict[str, Any]:
    return yaml.safe_load(Path(__file__).with_name("paper.yaml").read_text(encoding="utf-8"))


class Figure(NamedTuple):
    """A mean return in a table of the paper, with the policy's environment steps and its seeds."""

    value: float
    table: int
    steps: int
    seeds: int

    @property
    def source(self) -> str:
        """Where the number is from, for a caption."""
        return f"Table {self.table}, {self.steps:,} steps, {self.seeds} seeds"


def paper_figure(about: str, task: str, method: str, value: str | None = None) -> Figure | None:
    """The paper's figure for a method on a task, None if it has none.

    ``about`` is ``results``, or an ablation's name with the ``value`` of its setting.

    Examples:
        >>> paper_figure("results", "inverted_pendulum", "giril")
        Figure(value=990.2, table=5, steps=10000000, seeds=3)
        >>> paper_figure("beta", "breakout", "giril", "0.9").value
        361.5
    """
    for table in _paper()["tables"]:
        if table["about"] == about:
            found = table["tasks"].get(task, {}).get(method)
            if value is not None and isinstance(found, dict):
                found = found.get(value)
            if isinstance(found, (int, float)):
                return Figure(float(found), table["number"], table["steps"], table["seeds"])
    return None


@dataclass(frozen=True)
class Ablation:
    """A table about one thing that is varied, as ``paper.yaml`` describes it.

    Attributes:
        name: short name, used in file names and in ``paper.yaml``.
        title: the table's title.
        keys: the settings that are varied.
        methods: the methods that the table is about; empty: all that have the settings.
        label: a value in words, with ``{}`` for the value itself.
        words: words for single values.
    """

    name: str
    title: str
    keys: Sequence[str]
    methods: Sequence[str] = ()
    label: str = "{}"
    words: Mapping[str, str] | None = None

    def covers(self, method: str, changes: Changes) -> bool:
        """Whether a row with these changes belongs in the table."""
        ours = not self.methods or method in self.methods
        return ours and bool(changes) and {key for key, _ in changes} <= set(self.keys)

    def value(self, config: Mapping[str, Any]) -> str:
        """The row's value, as ``paper.yaml`` spells it.

        Examples:
            >>> ablations()[0].value({"reward.beta": 0.9})
            '0.9'
            >>> ablations()[-1].value({"demo.length": None, "demo.episodes": 5})
            '5'
        """
        if self.name == "demonstrations":
            length, episodes = config.get("demo.length"), config.get("demo.episodes")
            return str(episodes) if length is None else f"{length:,} transitions"
        return text_of(config.get(self.keys[0]))

    def in_words(self, config: Mapping[str, Any]) -> str:
        """The row's value in words.

        Examples:
            >>> ablations()[1].in_words({"scaling.enabled": False})
            'original'
        """
        value = self.value(config)
        if self.name == "demonstrations" and value.isdecimal():
            return f"{value} full episode{'s' if value != '1' else ''}"
        return (self.words or {}).get(value, self.label.format(value))


@cache
def ablations() -> tuple[Ablation, ...]:
    """The ablations that the paper has tables about."""
    return tuple(Ablation(**each) for each in _paper()["ablations"])


@dataclass(eq=False)
class Line:
    """A row as it stands in one table.

    Attributes:
        panel: the row's task.
        row: the row.
        value: what is varied, in words; empty in the table of results.
        paper: the paper's figure.
    """

    panel: Panel
    row: Row
    value: str
    paper: Figure | None

    @cached_property
    def normalised(self) -> tuple[Estimate, Estimate] | None:
        """Mean and interquartile mean of the row's normalised scores."""
        scores = self.panel.normalised(self.row)
        return mean_and_iqm(scores) if scores else None

    @cached_property
    def over_demonstration(self) -> Estimate | None:
        """Mean of the row's scores divided by the demonstrations' returns, in panels with SAC."""
        ratios = self.panel.over_demonstration(self.row) if self.panel.has_sac else []
        return mean_and_iqm(ratios)[0] if ratios else None

    @cached_property
    def improvement(self) -> tuple[Estimate, Row] | None:
        """Probability of improvement over the best control at the same budget, and that control."""
        best = self.panel.best_control(self.row)
        if best is None or self.row.is_control or self.row.method == PLAYER:
            return None
        return probability_of_improvement(self.row.scores, best.scores), best


@dataclass(eq=False)
class Table:
    """Lines of one task about one thing.

    Attributes:
        name: short name: ``results``, ``other`` or an ablation's.
        title: title in the report.
        panel: the task.
        lines: the lines in order.
    """

    name: str
    title: str
    panel: Panel
    lines: list[Line]

    @property
    def best(self) -> list[Line]:
        """The best lines of methods that imitate; empty if there are fewer than two scores."""
        scores = {
            id(line): round(line.row.estimates[0].value, 1)
            for line in self.lines
            if line.row.is_learned
        }
        if len(set(scores.values())) < 2:
            return []
        return [line for line in self.lines if scores.get(id(line)) == max(scores.values())]


def panels_of(runs: Sequence[RunRecord]) -> list[Panel]:
    """The runs by task: first the paper's tasks, each with the settings of ablations as rows."""
    keys = frozenset(key for ablation in ablations() for key in ablation.keys)
    known = {
        task
        for table in _paper()["tables"]
        if table["about"] == "results"
        for task in table["tasks"]
    }
    return sorted(group(runs, keys), key=lambda panel: panel.task not in known)


def tables_of(panel: Panel) -> list[Table]:
    """All tables of one task; each of its rows is in at least one of them."""
    found = [
        Table("results", "results", panel, [_line(panel, row, "results") for row in panel.main])
    ]
    left = [row for row in panel.rows if row.changes]
    for about in ablations():
        varied = [row for row in panel.rows if about.covers(row.method, row.changes)]
        left = [row for row in left if not about.covers(row.method, row.changes)]
        lines = [
            _line(panel, row, about.name, about.in_words(config), about.value(config))
            for row in _beside_their_own(panel, varied)
            for config in [row.runs[0].config]
        ]
        found.append(Table(about.name, about.title, panel, lines))
    lines = [
        _line(panel, row, "other", row.settings or "the recipe's own")
        for row in _beside_their_own(panel, left)
    ]
    found.append(Table("other", "other settings", panel, lines))
    return [table for table in found if table.lines]


def _beside_their_own(panel: Panel, varied: Sequence[Row]) -> list[Row]:
    """The rows, and those of the same methods and budgets with the recipe's own settings."""
    kinds = {(row.kind, row.steps) for row in varied}
    own = [row for row in panel.main if (row.kind, row.steps) in kinds]
    return sorted([*own, *varied], key=lambda row: row.order)


def _line(panel: Panel, row: Row, about: str, words: str = "", value: str | None = None) -> Line:
    # The paper's figures are of PPO on the unchanged task.
    other = panel.changes or row.algorithm == "sac"
    figure = None if other else paper_figure(about, panel.task, row.method, value)
    return Line(panel, row, words, figure)
