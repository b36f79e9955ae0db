"""Rows as tables: the results, an ablation each, and whatever else was varied."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from giril_rl.experiments.report.ablations import ABLATIONS, Ablation
from giril_rl.experiments.report.paper import Figure, paper_figure
from giril_rl.experiments.report.rows import Panel, Row
from giril_rl.experiments.report.statistics import (
    Estimate,
    mean_and_iqm,
    probability_of_improvement,
)


@dataclass
class Line:
    """A row as it stands in one table.

    Attributes:
        panel: the row's task.
        row: the row.
        value: what is varied, in words; empty in the table of results.
        paper: the paper's number for it.
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
    def improvement(self) -> tuple[Estimate, Row] | None:
        """Probability of improvement over the best control at the same budget, and that control."""
        best = self.panel.best_control(self.row)
        if best is None or self.row.is_control or self.row.method == "expert":
            return None
        return probability_of_improvement(self.row.scores, best.scores), best


@dataclass
class Table:
    """Lines of one task about one thing.

    Attributes:
        name: short name, ``results`` or an ablation's.
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
        """Of two or more lines of methods that imitate, the best; more than one where they tie."""
        scores = {
            id(line): round(line.row.estimates[0].value, 1)
            for line in self.lines
            if line.row.is_learned
        }
        if len(set(scores.values())) < 2:
            return []
        return [line for line in self.lines if scores.get(id(line)) == max(scores.values())]


def tables_of(panel: Panel) -> list[Table]:
    """All tables of one task; each of its rows is in at least one of them."""
    tables = [_results(panel), *(_ablation(panel, about) for about in ABLATIONS), _others(panel)]
    return [table for table in tables if table.lines]


def _results(panel: Panel) -> Table:
    lines = [Line(panel, row, "", _figure(panel, row, "results")) for row in panel.main]
    return Table("results", "results", panel, lines)


def _ablation(panel: Panel, about: Ablation) -> Table:
    varied = [row for row in panel.rows if about.covers(row.method, row.changes)]
    lines = []
    for row in _beside_their_own(panel, varied):
        config = row.runs[0].config
        figure = _figure(panel, row, about.name, about.value(config))
        lines.append(Line(panel, row, about.label(config), figure))
    return Table(about.name, about.title, panel, lines)


def _others(panel: Panel) -> Table:
    varied = [
        row
        for row in panel.rows
        if row.changes and not any(about.covers(row.method, row.changes) for about in ABLATIONS)
    ]
    lines = [
        Line(panel, row, row.settings or "the recipe's own", None)
        for row in _beside_their_own(panel, varied)
    ]
    return Table("other", "other settings", panel, lines)


def _beside_their_own(panel: Panel, varied: Sequence[Row]) -> list[Row]:
    """Rows and, before those of a method and budget, the one with the recipe's own settings."""
    kinds = {(row.method, row.profile, row.steps) for row in varied}
    own = [row for row in panel.main if (row.method, row.profile, row.steps) in kinds]
    return sorted([*own, *varied], key=lambda row: row.order)


def _figure(panel: Panel, row: Row, about: str, value: str | None = None) -> Figure | None:
    # With the task changed, the paper's number would be of something else.
    return None if panel.changes else paper_figure(about, panel.task, row.method, value)
