"""All tasks together: normalised scores, seeds resampled within each task."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from giril_rl.experiments.report.bars import comparable
from giril_rl.experiments.report.formats import budget_text, number, with_interval
from giril_rl.experiments.report.rows import Panel, Row
from giril_rl.experiments.report.statistics import mean_and_iqm


def overall(panels: Sequence[Panel]) -> str:
    """The table over tasks, as Markdown with its caption; empty with fewer than two tasks.

    A method stands in it that was run on every task, with the seeds that it has on each of them.

    Args:
        panels: the tasks; one without normalised scores is left out.
    """
    found = comparable(panels)
    if len(found) < 2:
        return ""
    kinds = {(row.method, row.profile): row for _, rows in found for row in rows}
    lines, missing = [], []
    for kind, first in kinds.items():
        rows = [
            (panel, row)
            for panel, rows in found
            for row in rows
            if (row.method, row.profile) == kind
        ]
        seeds = _common_seeds([row for _, row in rows])
        if len(rows) < len(found) or not seeds:
            missing.append(first.name)
            continue
        columns = [dict(zip(row.seeds, panel.normalised(row), strict=True)) for panel, row in rows]
        scores = np.array([[column[seed] for column in columns] for seed in seeds])
        lines.append((first, len(seeds), *mean_and_iqm(scores)))
    if not lines:
        return ""
    tasks = "; ".join(
        f"{panel.title} (random policy {number(panel.scale.random)}, player "
        f"{number(panel.reference('expert'))}, {budget_text(rows)})"
        for panel, rows in found
    )
    text = (
        f"Normalised scores over {len(found)} tasks: {tasks}. `n` is the number of seeds on each "
        "task.\n"
    )
    if missing:
        text += f"Not on every task, and so not here: {', '.join(missing)}.\n"
    learned = [mean.value for row, _, mean, _ in lines if row.is_learned]
    best = max(learned) if len(learned) > 1 else None
    head = "| method | n | normalised [95%] | IQM [95%] |\n|---|---|---|---|\n"
    return f"{text}\n{head}" + "".join(
        f"| {bold.format(row.name)} | {count} | {bold.format(with_interval(mean, 2))} "
        f"| {with_interval(middle, 2)} |\n"
        for row, count, mean, middle in lines
        for bold in ["**{}**" if row.is_learned and mean.value == best else "{}"]
    )


def _common_seeds(rows: Sequence[Row]) -> list[int]:
    common = set.intersection(*(set(row.seeds) for row in rows)) if rows else set()
    return sorted(common)
