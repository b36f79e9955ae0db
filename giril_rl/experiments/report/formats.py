"""Tables as Markdown and CSV, and the numbers and captions in them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from giril_rl.experiments.report.rows import Row
from giril_rl.experiments.report.statistics import Estimate
from giril_rl.experiments.report.tables import Line, Table
from giril_rl.files.disk import csv_text

COLUMNS = (
    "table",
    "task",
    "task_settings",
    "method",
    "settings",
    "steps",
    "n",
    "seeds",
    "mean",
    "mean_low",
    "mean_high",
    "iqm",
    "iqm_low",
    "iqm_high",
    "mode",
    "p_best_control",
    "p_low",
    "p_high",
    "best_control",
    "paper",
    "each_seed",
    "each_seed_mode",
    "demonstration",
    "expert",
    "life_length",
    "steps_per_second",
    "normalised",
    "normalised_low",
    "normalised_high",
    "normalised_iqm",
    "normalised_iqm_low",
    "normalised_iqm_high",
    "each_seed_normalised",
    "random",
)


def number(value: float | None) -> str:
    """A score in a table.

    Examples:
        >>> number(9164.94), number(None)
        ('9,164.9', '-')
    """
    return "-" if value is None else f"{value:,.1f}"


def with_interval(estimate: Estimate, digits: int = 1) -> str:
    """An estimate and its interval in a table.

    Examples:
        >>> with_interval(Estimate(20.0, 10.0, 30.0)), with_interval(Estimate(20.0, None, None))
        ('20.0 [10.0, 30.0]', '20.0')
    """
    text = f"{estimate.value:z,.{digits}f}"
    if estimate.low is None or estimate.high is None:
        return text
    return f"{text} [{estimate.low:z,.{digits}f}, {estimate.high:z,.{digits}f}]"


def reference_text(values: Sequence[float]) -> str:
    """A score to compare with; the mean, and the range, where seeds have their own.

    Examples:
        >>> reference_text([900.0]), reference_text([900.0, 1000.0])
        ('900.0', '950.0 (mean of 2, 900.0 to 1,000.0)')
    """
    mean = number(sum(values) / len(values))
    if len(values) == 1:
        return mean
    return f"{mean} (mean of {len(values)}, {number(min(values))} to {number(max(values))})"


def steps_text(row: Row) -> str:
    """Environment steps of a row's training; a range where runs stopped early.

    Examples:
        >>> steps_text(Row("giril", None, (), 1000))
        '0'
    """
    taken = row.trained_steps or [0]
    return f"{taken[0]:,}" if len(taken) == 1 else f"{taken[0]:,} to {taken[-1]:,}"


def seeds_text(rows: Iterable[Row]) -> str:
    """How many seeds rows have, for a caption; an expert's are not among them.

    Examples:
        >>> seeds_text([]), seeds_text([Row("giril", None, (), 1000)])
        ('no seeds', '0 seeds')
    """
    counts = sorted({len(row.runs) for row in rows if row.method != "expert"})
    if not counts:
        return "no seeds"
    words = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    return f"{words} seed{'' if counts == [1] else 's'}"


def budget_text(rows: Iterable[Row]) -> str:
    """The budgets of rows, for a caption: not an expert's, and not of what takes no steps.

    Examples:
        >>> budget_text([Row("bc", None, (), 0)])
        'no environment steps'
    """
    budgets = sorted({row.steps for row in rows if row.is_trained and row.method != "expert"})
    texts = [f"{steps:,}" for steps in budgets] or ["no"]
    return f"{' and '.join(filter(None, [', '.join(texts[:-1]), texts[-1]]))} environment steps"


def markdown(table: Table) -> str:
    """The table as Markdown, without its caption.

    The best of the methods that imitate is in bold. A column in which no line has anything is left
    out. All else that is known of a row is in the CSV.
    """
    best = table.best
    columns: dict[str, list[str]] = {}
    for line in table.lines:
        row = line.row
        bold = "**{}**" if line in best else "{}"
        values = {
            "method": bold.format(row.name),
            "setting": line.value,
            "n": str(len(row.runs)),
            "steps": steps_text(row),
            "score [95%]": bold.format(with_interval(row.estimates[0])),
            "normalised [95%]": with_interval(line.normalised[0], 2) if line.normalised else "",
            "P(> best control) [95%]": (
                with_interval(line.improvement[0], 2) if line.improvement else ""
            ),
            "paper": number(line.paper.value) if line.paper else "",
            "each seed": " ".join(number(score) for score in row.scores),
        }
        for name, value in values.items():
            columns.setdefault(name, []).append(value.replace("|", "\\|"))
    kept = {name: values for name, values in columns.items() if any(values)}
    rows = [list(kept), ["---"] * len(kept), *zip(*kept.values(), strict=True)]
    return "".join(f"| {' | '.join(value or '-' for value in row)} |\n" for row in rows)


def to_csv(tables: Sequence[Table]) -> str:
    """All lines of all tables as CSV with the columns :data:`COLUMNS`, numbers unrounded."""
    return csv_text(COLUMNS, (_cells(table, line) for table in tables for line in table.lines))


def _cells(table: Table, line: Line) -> list[Any]:
    row, panel = line.row, line.panel
    mean, middle = row.estimates
    better = line.improvement
    return [
        table.name,
        panel.task,
        " ".join(f"{key}={value}" for key, value in panel.changes),
        row.name,
        line.value,
        " ".join(map(str, row.trained_steps)),
        len(row.runs),
        " ".join(map(str, row.seeds)),
        *mean,
        *middle,
        row.mode_mean,
        *(better[0] if better else (None, None, None)),
        better[1].name if better else None,
        line.paper.value if line.paper else None,
        " ".join(map(str, row.scores)),
        " ".join(map(str, row.modes)),
        panel.reference("demo"),
        panel.reference("expert"),
        row.life_length,
        row.speed,
        *(line.normalised[0] if line.normalised else (None, None, None)),
        *(line.normalised[1] if line.normalised else (None, None, None)),
        " ".join(map(str, panel.normalised(row))),
        panel.scale.random,
    ]
