"""Tables as Markdown and CSV, and the numbers in them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from giril_rl.experiments.report.entries import PLAYER
from giril_rl.experiments.report.rows import Panel, Row, mean
from giril_rl.experiments.report.statistics import Estimate, mean_and_iqm
from giril_rl.experiments.report.tables import Line, Table
from giril_rl.files.disk import csv_text


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


def steps_text(row: Row) -> str:
    """Environment steps of a row's training; a range if runs stopped early.

    Examples:
        >>> steps_text(Row("giril", None, (), 1000))
        '0'
    """
    taken = row.trained_steps or [0]
    return f"{taken[0]:,}" if len(taken) == 1 else f"{taken[0]:,} to {taken[-1]:,}"


def seeds_text(rows: Iterable[Row]) -> str:
    """The number of seeds of the rows other than the expert's, for a caption.

    Examples:
        >>> seeds_text([]), seeds_text([Row("giril", None, (), 1000)])
        ('no seeds', '0 seeds')
    """
    counts = sorted({len(row.runs) for row in rows if row.method != PLAYER})
    if not counts:
        return "no seeds"
    words = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    return f"{words} seed{'' if counts == [1] else 's'}"


def budget_text(rows: Iterable[Row]) -> str:
    """The budgets of the rows that take environment steps, except the expert's, for a caption.

    Examples:
        >>> budget_text([Row("bc", None, (), 0)])
        'no environment steps'
    """
    budgets = sorted({row.steps for row in rows if row.is_trained and row.method != PLAYER})
    *first, last = [f"{steps:,}" for steps in budgets] or ["no"]
    return f"{' and '.join(filter(None, [', '.join(first), last]))} environment steps"


def markdown(rows: Sequence[Mapping[str, str]]) -> str:
    r"""Rows of ``{column: text}`` as a Markdown table; columns without any text are left out.

    Examples:
        >>> print(markdown([{"run": "a|b", "n": "", "of": ""}, {"run": "c", "n": "2", "of": ""}]))
        | run | n |
        | --- | --- |
        | a\|b | - |
        | c | 2 |
        <BLANKLINE>
    """
    columns = [name for name in rows[0] if any(row[name] for row in rows)]
    cells = [[row[name].replace("|", "\\|") or "-" for name in columns] for row in rows]
    return "".join(f"| {' | '.join(row)} |\n" for row in [columns, ["---"] * len(columns), *cells])


def table_markdown(table: Table) -> str:
    """A table as Markdown, without its caption. The best method that imitates is in bold."""
    rows = []
    best = table.best
    for line in table.lines:
        row = line.row
        bold = "**{}**" if line in best else "{}"
        rows.append(
            {
                "method": bold.format(row.name),
                "setting": line.value,
                "n": str(len(row.runs)),
                "steps": steps_text(row),
                "score [95%]": bold.format(with_interval(row.estimates[0])),
                "normalised [95%]": with_interval(line.normalised[0], 2) if line.normalised else "",
                "over demonstration [95%]": (
                    with_interval(line.over_demonstration, 2) if line.over_demonstration else ""
                ),
                "P(> best control) [95%]": (
                    with_interval(line.improvement[0], 2) if line.improvement else ""
                ),
                "paper": number(line.paper.value) if line.paper else "",
                "each seed": " ".join(map(number, row.scores)),
            }
        )
    return markdown(rows)


def results_csv(tables: Sequence[Table]) -> str:
    """All lines of all tables as CSV, with unrounded numbers.

    What only SAC makes necessary has columns only where a run has it.
    """
    rows = [_record(table, line) for table in tables for line in table.lines]
    if any(table.panel.has_sac for table in tables):
        lines = [line for table in tables for line in table.lines]
        rows = [row | _beside_sac(line) for row, line in zip(rows, lines, strict=True)]
    return csv_text(rows[0], (row.values() for row in rows))


def _record(table: Table, line: Line) -> dict[str, Any]:
    row, panel = line.row, line.panel
    score, score_iqm = row.estimates
    none = Estimate(*[None] * 3)  # type: ignore[arg-type]
    better, control = line.improvement or (none, None)
    normalised, normalised_iqm = line.normalised or (none, none)
    return {
        "table": table.name,
        "task": panel.task,
        "task_settings": " ".join(f"{key}={value}" for key, value in panel.changes),
        "method": row.name,
        "settings": line.value,
        "steps": _words(row.trained_steps),
        "n": len(row.runs),
        "seeds": _words(row.seeds),
        **_columns("mean", "mean", score),
        **_columns("iqm", "iqm", score_iqm),
        "mode": mean(row.modes),
        **_columns("p_best_control", "p", better),
        "best_control": control.name if control else None,
        "paper": line.paper.value if line.paper else None,
        "each_seed": _words(row.scores),
        "each_seed_mode": _words(row.modes),
        "demonstration": mean(panel.references("demo")),
        "expert": mean(panel.references("expert")),
        "life_length": row.mean_of("life_length_mean"),
        "steps_per_second": row.mean_of("steps_per_second") if row.is_trained else None,
        **_columns("normalised", "normalised", normalised),
        **_columns("normalised_iqm", "normalised_iqm", normalised_iqm),
        "each_seed_normalised": _words(panel.normalised(row)),
        "random": panel.random,
    }


def _beside_sac(line: Line) -> dict[str, Any]:
    none = Estimate(*[None] * 3)  # type: ignore[arg-type]
    over = line.over_demonstration or none
    return {
        "algorithm": line.row.algorithm,
        **_columns("over_demonstration", "over_demonstration", over),
        "each_seed_over_demonstration": _words(
            line.panel.over_demonstration(line.row) if line.over_demonstration else []
        ),
    }


def _words(values: Iterable[Any]) -> str:
    return " ".join(map(str, values))


def _columns(name: str, bounds: str, estimate: Estimate) -> dict[str, float | None]:
    return dict(zip((name, f"{bounds}_low", f"{bounds}_high"), estimate, strict=True))


def longest(rows: Iterable[Row]) -> list[Row]:
    """The row with the largest budget for each method and algorithm, except the expert.

    Examples:
        >>> [row.steps for row in longest([Row("bc", None, (), 10), Row("bc", None, (), 20)])]
        [20]
    """
    found: dict[tuple[str, str | None, str | None], Row] = {}
    for row in rows:
        key = row.kind
        if row.method != PLAYER and (key not in found or row.steps > found[key].steps):
            found[key] = row
    return list(found.values())


def comparable(panels: Sequence[Panel]) -> list[tuple[Panel, list[Row]]]:
    """The tasks that have normalised scores, with their main rows that have them.

    A method that was run with several budgets is shown with the largest.
    """
    found = [
        (panel, [row for row in longest(panel.main) if panel.normalised(row)]) for panel in panels
    ]
    return [(panel, rows) for panel, rows in found if rows]


def overall(panels: Sequence[Panel]) -> str:
    """The table over all tasks, as Markdown with its caption; empty with fewer than two tasks.

    It has the methods that were run on every task, with the seeds that they have on each of them.
    """
    found = comparable(panels)
    kinds: dict[tuple[str, str | None, str | None], list[dict[int, float]]] = {}
    shown: dict[tuple[str, str | None, str | None], Row] = {}
    for panel, rows in found:
        for row in rows:
            kind = row.kind
            scores = dict(zip(row.seeds, panel.normalised(row), strict=True))
            kinds.setdefault(kind, []).append(scores)
            if row.beside_sac or kind not in shown:
                shown[kind] = row
    lines, missing = [], []
    for kind, tasks in kinds.items():
        seeds = sorted(set.intersection(*map(set, tasks)))
        if len(tasks) < len(found) or not seeds:
            missing.append(shown[kind].name)
            continue
        estimates = mean_and_iqm(*([task[seed] for seed in seeds] for task in tasks))
        lines.append((shown[kind], len(seeds), *estimates))
    if len(found) < 2 or not lines:
        return ""
    about = "; ".join(
        f"{panel.title} (random policy {number(panel.random)}, player "
        f"{number(mean(panel.references('expert')))}, {budget_text(rows)})"
        for panel, rows in found
    )
    text = (
        f"Normalised scores over {len(found)} tasks: {about}. `n` is the number of seeds on each "
        "task.\n"
    )
    if missing:
        text += f"Not on every task, and so not here: {', '.join(missing)}.\n"
    learned = [each.value for row, _, each, _ in lines if row.is_learned]
    best = max(learned) if len(learned) > 1 else None
    table = [
        {
            "method": bold.format(row.name),
            "n": str(count),
            "normalised [95%]": bold.format(with_interval(each, 2)),
            "IQM [95%]": with_interval(middle, 2),
        }
        for row, count, each, middle in lines
        for bold in ["**{}**" if row.is_learned and each.value == best else "{}"]
    ]
    return f"{text}\n{markdown(table)}"
