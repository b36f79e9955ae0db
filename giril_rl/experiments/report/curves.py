"""Learning curves: the mean over seeds with its 95% interval, a line for each row of a table."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np

from giril_rl.experiments.report.formats import budget_text, seeds_text
from giril_rl.experiments.report.rows import Panel, Row, longest
from giril_rl.experiments.report.statistics import band
from giril_rl.experiments.report.style import DEMONSTRATION, EXPERT, PALETTE, Look
from giril_rl.experiments.report.tables import Table
from giril_rl.runs.curve import curve_points, new_figure, save, thousands

BINS = 50
LEGEND = 70  # characters in a line of a legend


def binned_curve(
    points: Sequence[tuple[int, float, int | None]], steps: int, bins: int = BINS
) -> np.ndarray:
    """Mean return of the episodes that ended in each of ``bins`` equal stretches of training.

    Args:
        points: (environment steps, mean return, episodes in that mean), see
            :func:`giril_rl.runs.curve.curve_points`.
        steps: length of the training.
        bins: number of stretches.

    Returns:
        Shape ``(bins,)``; a stretch in which no episode ended repeats the one before, NaN at first.

    Examples:
        >>> binned_curve([(1, 2.0, 1), (2, 5.0, 2), (4, 9.0, 1)], steps=4, bins=2).tolist()
        [4.0, 9.0]
    """
    total, count = np.zeros(bins), np.zeros(bins)
    for step, mean, episodes in points:
        index = min((step - 1) * bins // steps, bins - 1)
        weight = 1 if episodes is None else episodes
        total[index] += weight * mean
        count[index] += weight
    curve = np.full(bins, np.nan)
    for index in range(bins):
        if count[index]:
            curve[index] = total[index] / count[index]
        elif index:
            curve[index] = curve[index - 1]
    return curve


def row_curves(row: Row, bins: int = BINS) -> tuple[np.ndarray, np.ndarray] | None:
    """Environment steps ``(points,)`` and each seed's curve ``(seeds, points)`` of a row.

    None where no training episode is on record, as for a method that does not train in the
    environment. Points before every seed has ended an episode are left out.
    """
    steps = max(row.trained_steps, default=0)
    points = [curve_points(run.metrics()) for run in row.runs]
    if not steps or not all(points):
        return None
    curves = np.array([binned_curve(each, steps, bins) for each in points])
    kept = ~np.isnan(curves).any(0)
    return ((np.arange(bins) + 1) * steps / bins)[kept], curves[:, kept]


def draw_results(table: Table, path: Path) -> bool:
    """Write a task's picture: learned rewards on the left, controls on the right.

    Args:
        table: the task's table of results.
        path: the PNG file.

    Returns:
        Whether there was a curve to draw.
    """
    rows = longest(line.row for line in table.lines)
    parts = [
        ("methods", [row for row in rows if not row.is_control]),
        ("controls", [row for row in rows if row.is_control]),
    ]
    return _draw(
        table.panel,
        [
            (
                title,
                part,
                [row.name.removeprefix("control: ") for row in part],
                [row.look for row in part],
            )
            for title, part in parts
            if part
        ],
        rows,
        path,
    )


def draw_varied(table: Table, path: Path) -> bool:
    """Write an ablation's picture: a part for each method, a line for each value.

    A value has one colour in all parts.

    Args:
        table: the ablation's table.
        path: the PNG file.

    Returns:
        Whether there was a curve to draw.
    """
    parts = []
    looks: dict[str, Look] = {}
    for name in dict.fromkeys(line.row.name for line in table.lines):
        lines = [line for line in table.lines if line.row.name == name]
        values = [line.value for line in lines]
        labels = [
            f"{line.value}, {line.row.steps:,} steps"
            if values.count(line.value) > 1
            else line.value
            for line in lines
        ]
        for label in labels:
            color = PALETTE[len(looks) % len(PALETTE)]
            looks.setdefault(label, Look(color, "-" if len(looks) < len(PALETTE) else "--"))
        parts.append((name, [line.row for line in lines], labels, [looks[x] for x in labels]))
    return _draw(table.panel, parts, [line.row for line in table.lines], path, about=table.title)


def _draw(
    panel: Panel,
    parts: Sequence[tuple[str, Sequence[Row], Sequence[str], Sequence[Look]]],
    rows: Sequence[Row],
    path: Path,
    about: str = "",
) -> bool:
    curves = {id(row): row_curves(row) for row in rows}
    if not any(curves.values()):
        return False
    columns = 2 if len(parts) == 4 else min(len(parts), 3)
    lines = -(-len(parts) // columns)
    widest = max(len(label) for _, _, labels, _ in parts for label in labels)
    ncols = 1 if widest > 36 else 2
    entries = max(sum(len(wrap(x, LEGEND)) for x in labels) for _, _, labels, _ in parts) + 2
    figure = new_figure(6.2 * columns, (4.6 + 0.2 * -(-entries // ncols)) * lines + 0.4)
    grid = figure.subplots(lines, columns, squeeze=False, sharey=True, sharex=True).flatten()
    for axes, (title, part, labels, styles) in zip(grid, parts, strict=False):
        for row, label, style in zip(part, labels, styles, strict=True):
            _line(axes, row, curves[id(row)], label, style)
        _references(axes, panel)
        axes.set_title(title)
        axes.set_xlabel("environment steps")
        axes.tick_params(labelbottom=True, labelleft=True)
        thousands(axes.xaxis)
        thousands(axes.yaxis)
        axes.grid(alpha=0.3)
        # Below the axes: nothing of a curve is covered.
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=ncols, fontsize=8)
    # Once all are drawn: the axes share their limits.
    grid[0].set_xlim(0, 1.05 * max(row.trained_steps[-1] for row in rows))
    for axes in grid[::columns]:
        axes.set_ylabel("true return of training episodes")
    for axes in grid[len(parts) :]:
        axes.set_visible(False)
    title = f"{panel.title}{f': {about}' if about else ''}"
    caption = f"{seeds_text(rows)}, {budget_text(rows)}; mean and 95% bootstrap band"
    room = 72 * columns
    figure.suptitle("\n".join([*wrap(title, room), *wrap(caption, room)]), fontsize=11)
    save(figure, path)
    return True


def _references(axes: Any, panel: Panel) -> None:
    for who, name, color, linestyle, width in (
        ("expert", "expert", EXPERT, (0, (6, 3)), 1.0),
        ("demo", panel.demonstration, DEMONSTRATION, (0, (1, 1)), 2.2),
    ):
        values = panel.references(who)
        if values:
            value = sum(values) / len(values)
            name += f", mean of {len(values)}" if len(values) > 1 else ""
            axes.axhline(
                value,
                color=color,
                linestyle=linestyle,
                linewidth=width,
                label=f"{name} ({value:,.1f})",
                zorder=1,
            )


def _line(
    axes: Any, row: Row, found: tuple[np.ndarray, np.ndarray] | None, label: str, style: Look
) -> None:
    label = "\n".join(wrap(f"{label}, n = {len(row.runs)}", LEGEND))
    if found is None:
        axes.axhline(
            row.estimates[0].value,
            color=style.color,
            linestyle=(0, (4, 2, 1, 2, 1, 2)),
            label=f"{label} (final score)",
        )
        return
    steps, curves = found
    axes.plot(steps, curves.mean(0), color=style.color, linestyle=style.linestyle, label=label)
    if len(curves) > 1 and len(steps):
        low, high = band(curves)
        axes.fill_between(steps, low, high, color=style.color, alpha=0.18, linewidth=0)
