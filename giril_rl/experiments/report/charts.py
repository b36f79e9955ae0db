"""Charts of the report: final scores as bars, and learning curves."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np

from giril_rl.experiments.report.entries import PALETTE
from giril_rl.experiments.report.rows import Look, Panel, Row
from giril_rl.experiments.report.statistics import Estimate, band, mean_and_iqm
from giril_rl.experiments.report.tables import Table
from giril_rl.experiments.report.text import budget_text, comparable, longest, seeds_text
from giril_rl.rewards.method import BLACK, GREY
from giril_rl.runs.curve import curve_points, new_figure, save, thousands

BINS = 50
LEGEND = 70  # Characters in a line of a legend.
DASHED, DOTTED = (0, (6, 3)), (0, (1, 1))
MOST = 8
"""Lines in one part of a picture of many; :data:`PALETTE` has as many colours."""
Part = tuple[str, list[tuple[Row, str, Look]]]
"""A part of a picture: its title, and its rows with their labels and looks."""


def draw_bars(panels: Sequence[Panel], path: Path) -> bool:
    """Write the PNG of the tasks' normalised scores; False if there is none."""
    found = comparable(panels)
    if not found:
        return False
    most = max(len(rows) for _, rows in found)
    width = 7.0 if any(panel.has_sac for panel, _ in found) else 5.4  # Names are longer.
    figure, grid, columns = _grid(len(found), width, 1.3 + 0.32 * most, extra=0.7)
    for axes, (panel, rows) in zip(grid, found, strict=True):
        for end, style in ((0.0, DOTTED), (1.0, DASHED)):
            axes.axvline(end, color=BLACK, linestyle=style, linewidth=1.2, zorder=1)
        for place, row in enumerate(rows):
            _bar(axes, place, row, mean_and_iqm(panel.normalised(row))[0])
        axes.set_yticks(range(len(rows)), [f"{row.name} ({len(row.runs)})" for row in rows])
        axes.invert_yaxis()
        axes.margins(x=0.05)
        axes.set_title(f"{panel.title}\n{budget_text(rows)}", fontsize=10)
        axes.set_xlabel("normalised score")
        axes.grid(axis="x", alpha=0.3)
    title = (
        "Final scores between a random policy (0, dotted) and the player (1, dashed); "
        f"{seeds_text(row for _, rows in found for row in rows)} (in brackets), "
        "95% bootstrap intervals"
    )
    figure.suptitle("\n".join(wrap(title, 62 * columns)), fontsize=11)
    save(figure, path)
    return True


def _grid(
    parts: int, width: float, height: float, *, extra: float, most: int = 3, **shared: Any
) -> Any:
    """A figure with axes for each part, and its number of columns."""
    columns = 2 if parts == 4 and shared else min(parts, most)
    lines = -(-parts // columns)
    figure = new_figure(width * columns, height * lines + extra)
    grid = figure.subplots(lines, columns, squeeze=False, **shared).flatten()
    for axes in grid[parts:]:
        axes.set_visible(False)
    return figure, grid[:parts], columns


def _bar(axes: Any, place: int, row: Row, mean: Estimate) -> None:
    colour = GREY if row.is_control else row.look.color
    hatch = "///" if row.profile == "paper" else ""
    hatch += ".." if row.beside_sac and row.algorithm == "ppo" else ""
    axes.barh(place, mean.value, color=colour, alpha=0.85, hatch=hatch or None, height=0.7)
    if mean.low is not None and mean.high is not None:
        axes.plot([mean.low, mean.high], [place, place], color="black", linewidth=1.4, marker="|")
    # Beside the axes, where no line crosses the number.
    axes.annotate(
        f"{mean.value:z.2f}",
        (1.015, place),
        xycoords=("axes fraction", "data"),
        va="center",
        fontsize=8,
    )


def binned_curve(
    points: Sequence[tuple[int, float, int | None]], steps: int, bins: int = BINS
) -> np.ndarray:
    """Mean return of the episodes that ended in each of ``bins`` equal intervals of ``steps``.

    An interval without an episode repeats the one before; NaN at first. The points are those of
    :func:`giril_rl.runs.curve.curve_points`.

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

    Points before every seed has ended an episode are left out. None if a run has no training
    episodes, as with cloning.
    """
    steps = max(row.trained_steps, default=0)
    points = [curve_points(run.metrics()) for run in row.runs]
    if not steps or not all(points):
        return None
    curves = np.array([binned_curve(each, steps, bins) for each in points])
    kept = ~np.isnan(curves).any(0)
    return ((np.arange(bins) + 1) * steps / bins)[kept], curves[:, kept]


def draw_results(table: Table, path: Path) -> list[Path]:
    """Write the PNG of a task's learning curves, controls on the right; empty if there is none.

    Where runs have SAC, or more than 8 methods are drawn, a part has at most 8 lines and each
    method of a part its own colour. More than 8 rows then take two pictures: the second, of
    controls, is named ``-controls.png``.
    """
    rows = longest(line.row for line in table.lines)
    kinds = {
        "methods": [row for row in rows if not row.is_control],
        "controls": [row for row in rows if row.is_control],
    }
    kinds = {name: each for name, each in kinds.items() if each}
    if not table.panel.has_sac and len(kinds.get("methods", [])) <= MOST:
        parts = [(name, [_labelled(row) for row in each]) for name, each in kinds.items()]
        return [path] if _draw_curves(table.panel, parts, path) else []
    split = {name: _parts(name, each) for name, each in kinds.items()}
    if len(rows) <= MOST:
        every = [part for parts in split.values() for part in parts]
        return [path] if _draw_curves(table.panel, every, path, columns=2) else []
    paths = {"methods": path, "controls": path.with_stem(f"{path.stem}-controls")}
    return [
        paths[name]
        for name, each in split.items()
        if _draw_curves(table.panel, each, paths[name], columns=2)
    ]


def _labelled(row: Row) -> tuple[Row, str, Look]:
    return row, row.name.removeprefix("control: "), row.look


def _parts(kind: str, rows: Sequence[Row]) -> list[Part]:
    """The rows in parts of at most 8 lines, about equally many, with those of a method together."""
    count = -(-len(rows) // MOST)
    most = -(-len(rows) // count)
    parts: list[list[Row]] = [[]]
    for method in dict.fromkeys(row.method for row in rows):
        same = [row for row in rows if row.method == method]
        if parts[-1] and len(parts[-1]) + len(same) > most:
            parts.append([])
        parts[-1] += same
    titles = [f"{kind}, {i} of {len(parts)}" for i in range(1, len(parts) + 1)]
    return [
        (title if len(parts) > 1 else kind, _told_apart(part))
        for title, part in zip(titles, parts, strict=True)
    ]


def _told_apart(rows: Sequence[Row]) -> list[tuple[Row, str, Look]]:
    """The rows with their looks, but for methods whose colour one before them has already."""
    colours: dict[str, str] = {}
    for row in rows:
        if row.look.color not in colours.values():
            colours.setdefault(row.method, row.look.color)
    for row in rows:
        free = [color for color in PALETTE if color not in colours.values()]
        colours.setdefault(row.method, next(iter(free), row.look.color))
    labelled = [_labelled(row) for row in rows]
    return [(row, name, look._replace(color=colours[row.method])) for row, name, look in labelled]


def draw_varied(table: Table, path: Path) -> list[Path]:
    """Write the PNG of an ablation's learning curves; empty if there is none.

    It has a part for each method and a line for each value, with the same colour in all parts.
    """
    parts: dict[str, list[tuple[Row, str, Look]]] = {}
    looks: dict[str, Look] = {}
    kinds = [(line.row.name, line.value) for line in table.lines]
    for line, kind in zip(table.lines, kinds, strict=True):
        several = kinds.count(kind) > 1
        label = f"{line.value}, {line.row.steps:,} steps" if several else line.value
        color = PALETTE[len(looks) % len(PALETTE)]
        style = looks.setdefault(label, Look(color, "-" if len(looks) < len(PALETTE) else "--"))
        parts.setdefault(line.row.name, []).append((line.row, label, style))
    about = f": {table.title}"
    return [path] if _draw_curves(table.panel, list(parts.items()), path, about) else []


def _draw_curves(
    panel: Panel, parts: Sequence[Part], path: Path, about: str = "", columns: int = 3
) -> bool:
    rows = [row for _, lines in parts for row, _, _ in lines]
    curves = {id(row): row_curves(row) for row in rows}
    if not any(curves.values()):
        return False
    labels = [[label for _, label, _ in lines] for _, lines in parts]
    ncols = 1 if max(len(label) for part in labels for label in part) > 36 else 2
    entries = max(sum(len(wrap(label, LEGEND)) for label in part) for part in labels) + 2
    height = 4.6 + 0.2 * -(-entries // ncols)
    figure, grid, columns = _grid(
        len(parts), 6.2, height, extra=0.4, most=columns, sharex=True, sharey=True
    )
    for axes, (title, lines) in zip(grid, parts, strict=True):
        for row, label, style in lines:
            _line(axes, row, curves[id(row)], label, style)
        _references(axes, panel)
        axes.set_title(title)
        axes.set_xlabel("environment steps")
        axes.tick_params(labelbottom=True, labelleft=True)
        thousands(axes.xaxis)
        thousands(axes.yaxis)
        axes.grid(alpha=0.3)
        # Below the axes, where it covers no curve.
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=ncols, fontsize=8)
    # After all lines are drawn, for the axes share their limits.
    grid[0].set_xlim(0, 1.05 * max(row.trained_steps[-1] for row in rows))
    for axes in grid[::columns]:
        axes.set_ylabel("true return of training episodes")
    text = f"{seeds_text(rows)}, {budget_text(rows)}; mean and 95% bootstrap band"
    room = 72 * columns
    title = "\n".join([*wrap(f"{panel.title}{about}", room), *wrap(text, room)])
    figure.suptitle(title, fontsize=11)
    save(figure, path)
    return True


def _references(axes: Any, panel: Panel) -> None:
    for who, name, color, linestyle, width in (
        ("expert", "expert", BLACK, DASHED, 1.0),
        ("demo", panel.demonstration, GREY, DOTTED, 2.2),
    ):
        values = panel.references(who)
        if values:
            value = sum(values) / len(values)
            name += f", mean of {len(values)}" if len(values) > 1 else ""
            label = f"{name} ({value:,.1f})"
            axes.axhline(
                value, color=color, linestyle=linestyle, linewidth=width, label=label, zorder=1
            )


def _line(
    axes: Any, row: Row, found: tuple[np.ndarray, np.ndarray] | None, label: str, style: Look
) -> None:
    label = "\n".join(wrap(f"{label}, n = {len(row.runs)}", LEGEND))
    if found is None:
        value, dashes = row.estimates[0].value, (0, (4, 2, 1, 2, 1, 2))
        label = f"{label} (final score)"
        axes.axhline(value, color=style.color, linestyle=dashes, label=label)
        return
    steps, curves = found
    axes.plot(steps, curves.mean(0), color=style.color, linestyle=style.linestyle, label=label)
    if len(curves) > 1 and len(steps):
        low, high = band(curves)
        axes.fill_between(steps, low, high, color=style.color, alpha=0.18, linewidth=0)
