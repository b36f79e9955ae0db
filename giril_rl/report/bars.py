"""Final scores as bars, in units of the demonstration's score."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap

from giril_rl.report.drawing import new_figure, save
from giril_rl.report.formats import budget_text, seeds_text
from giril_rl.report.rows import Panel, Row, longest
from giril_rl.report.style import CONTROL, DEMONSTRATION, EXPERT, GREY, look


def comparable(panels: Sequence[Panel]) -> list[tuple[Panel, float, list[Row]]]:
    """Tasks whose demonstration has a positive score, with that score and their main rows.

    A method that was run with several budgets is shown with the largest.
    """
    found = []
    for panel in panels:
        score = panel.reference("demo")
        rows = longest(panel.main)
        if score is not None and score > 0 and rows:
            found.append((panel, score, rows))
    return found


def draw_bars(panels: Sequence[Panel], path: Path) -> bool:
    """Write the picture; whether there was anything to draw.

    Args:
        panels: the tasks; one without a demonstration, or one whose score is not positive, is
            left out.
        path: the PNG file.
    """
    found = comparable(panels)
    if not found:
        return False
    columns = min(len(found), 3)
    lines = -(-len(found) // columns)
    most = max(len(rows) for _, _, rows in found)
    figure = new_figure(5.4 * columns, (1.3 + 0.32 * most) * lines + 0.7)
    grid = figure.subplots(lines, columns, squeeze=False).flatten()
    for axes, (panel, score, rows) in zip(grid, found, strict=False):
        for place, row in enumerate(rows):
            mean = row.estimates[0]
            colour = GREY if row.method.startswith(CONTROL) else look(row.method, None, place).color
            hatch = "///" if row.profile == "paper" else None
            axes.barh(place, mean.value / score, color=colour, alpha=0.85, hatch=hatch, height=0.7)
            if mean.low is not None and mean.high is not None:
                ends = [mean.low / score, mean.high / score]
                axes.plot(ends, [place, place], color="black", linewidth=1.4, marker="|")
            # Beside the axes: no number lies on a line.
            axes.annotate(
                f"{mean.value / score:.2f}",
                (1.015, place),
                xycoords=("axes fraction", "data"),
                va="center",
                fontsize=8,
            )
        axes.set_yticks(range(len(rows)), [f"{row.name} ({len(row.runs)})" for row in rows])
        axes.invert_yaxis()
        axes.axvline(1.0, color=DEMONSTRATION, linestyle=(0, (1, 1)), linewidth=2.2)
        expert = panel.reference("expert")
        if expert is not None:
            axes.axvline(expert / score, color=EXPERT, linestyle=(0, (6, 3)), linewidth=1.0)
        axes.margins(x=0.05)
        axes.set_title(f"{panel.title}\n{budget_text(rows)}", fontsize=10)
        axes.set_xlabel(f"mean score / score of the {panel.demonstration}")
        axes.grid(axis="x", alpha=0.3)
    for axes in grid[len(found) :]:
        axes.set_visible(False)
    every = [row for _, _, rows in found for row in rows]
    title = (
        f"Final scores, demonstration = 1 (dotted), expert dashed; {seeds_text(every)} "
        "(in brackets), 95% bootstrap intervals"
    )
    figure.suptitle("\n".join(wrap(title, 62 * columns)), fontsize=11)
    save(figure, path)
    return True
