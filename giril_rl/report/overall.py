"""All tasks together: scores in units of the demonstration's, seeds resampled within each task."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from giril_rl.report.bars import comparable
from giril_rl.report.formats import budget_text, with_interval
from giril_rl.report.rows import Panel, Row
from giril_rl.report.statistics import mean_and_iqm


def overall(panels: Sequence[Panel]) -> str:
    """The table over tasks, as Markdown with its caption; empty with fewer than two tasks.

    A method stands in it that was run on every task, with the seeds that it has on each of them.

    Args:
        panels: the tasks; one whose demonstration has no positive score is left out.
    """
    found = comparable(panels)
    if len(found) < 2:
        return ""
    names = list(dict.fromkeys(row.name for _, _, rows in found for row in rows))
    lines, missing = [], []
    for name in names:
        rows = [(score, row) for _, score, rows in found for row in rows if row.name == name]
        seeds = _common_seeds([row for _, row in rows])
        if len(rows) < len(found) or not seeds:
            missing.append(name)
            continue
        scores = np.array(
            [[row.scores[row.seeds.index(seed)] / score for score, row in rows] for seed in seeds]
        )
        mean, middle = mean_and_iqm(scores)
        lines.append(
            f"| {name} | {len(seeds)} | {with_interval(mean, 2)} | {with_interval(middle, 2)} |"
        )
    if not lines:
        return ""
    tasks = "; ".join(
        f"{panel.title} ({panel.demonstration} {score:,.1f}, {budget_text(rows)})"
        for panel, score, rows in found
    )
    text = (
        f"Scores divided by the demonstration's, over {len(found)} tasks: {tasks}. `n` is the "
        "number of seeds on each task.\n"
    )
    if missing:
        text += f"Not on every task, and so not here: {', '.join(missing)}.\n"
    head = "| method | n | mean [95%] | IQM [95%] |\n|---|---|---|---|\n"
    return f"{text}\n{head}" + "\n".join(lines) + "\n"


def _common_seeds(rows: Sequence[Row]) -> list[int]:
    common = set.intersection(*(set(row.seeds) for row in rows)) if rows else set()
    return sorted(common)
