"""Final scores as bars, between a random policy's and the player's."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap
from typing import Any

from giril_rl.experiments.report.formats import budget_text, seeds_text
from giril_rl.experiments.report.rows import Panel, Row, longest
from giril_rl.experiments.report.statistics import Estimate, mean_and_iqm
from giril_rl.experiments.report.style import BLACK, GREY
from giril_rl.runs.curve import new_figure, save


def comparable(panels: Sequence[Panel]) -> list[tuple[Panel, list[Row]]]:
    """The tasks that have normalised scores, with those of their main rows that have them.

    A method that was run with several budgets is shown with the largest.
    """
    found = [
        (panel, [row for row in longest(panel.main) if panel.normalised(row)]) for panel in panels
    ]
    return [(panel, rows) for panel, rows in found if rows]


def draw_bars(panels: Sequence[Panel], path: Path) -> bool:
    """Write the picture; whether there was anything to draw.

    Args:
        panels: the tasks; one without normalised scores is left out.
        path: the PNG file.
    """
    found = comparable(panels)
    if not found:
        return False
    columns = min(len(found), 3)
    lines = -(-len(found) // columns)
    most = max(len(rows) for _, rows in found)
    figure = new_figure(5.4 * columns, (1.3 + 0.32 * most) * lines + 0.7)
    grid = figure.subplots(lines, columns, squeeze=False).flatten()
    for axes, (panel, rows) in zip(grid, found, strict=False):
        for end, style in ((0.0, (0, (1, 1))), (1.0, (0, (6, 3)))):
            axes.axvline(end, color=BLACK, linestyle=style, linewidth=1.2, zorder=1)
        for place, row in enumerate(rows):
            _bar(axes, place, row, mean_and_iqm(panel.normalised(row))[0])
        axes.set_yticks(range(len(rows)), [f"{row.name} ({len(row.runs)})" for row in rows])
        axes.invert_yaxis()
        axes.margins(x=0.05)
        axes.set_title(f"{panel.title}\n{budget_text(rows)}", fontsize=10)
        axes.set_xlabel("normalised score")
        axes.grid(axis="x", alpha=0.3)
    for axes in grid[len(found) :]:
        axes.set_visible(False)
    every = [row for _, rows in found for row in rows]
    title = (
        "Final scores between a random policy (0, dotted) and the player (1, dashed); "
        f"{seeds_text(every)} (in brackets), 95% bootstrap intervals"
    )
    figure.suptitle("\n".join(wrap(title, 62 * columns)), fontsize=11)
    save(figure, path)
    return True


def _bar(axes: Any, place: int, row: Row, mean: Estimate) -> None:
    colour = GREY if row.is_control else row.look.color
    hatch = "///" if row.profile == "paper" else None
    axes.barh(place, mean.value, color=colour, alpha=0.85, hatch=hatch, height=0.7)
    if mean.low is not None and mean.high is not None:
        axes.plot([mean.low, mean.high], [place, place], color="black", linewidth=1.4, marker="|")
    # Beside the axes: no number lies on a line.
    axes.annotate(
        f"{mean.value:z.2f}",
        (1.015, place),
        xycoords=("axes fraction", "data"),
        va="center",
        fontsize=8,
    )
