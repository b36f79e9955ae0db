"""Learning curves of many runs: a panel for each task and budget, a line for each kind of run."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from giril_rl.files import write_atomically
from giril_rl.report.curve import curve_points
from giril_rl.training.metrics import read_metrics

BINS = 50


def binned_curve(
    points: Sequence[tuple[int, float, int | None]], steps: int, bins: int = BINS
) -> np.ndarray:
    """Mean return of the episodes that ended in each of ``bins`` equal stretches of training.

    Args:
        points: (environment steps, mean return, episodes in that mean), see
            :func:`giril_rl.report.curve.curve_points`.
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


def draw_curves(
    panels: Mapping[str, Mapping[str, Sequence[Path]]], steps: Mapping[str, int], path: Path
) -> None:
    """Write a picture with the mean over seeds and the band between the lowest and highest seed.

    Args:
        panels: ``{panel title: {line's label: run folders that differ in their seed alone}}``.
        steps: the training's length in each panel.
        path: the PNG file.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter

    columns = min(len(panels), 2)
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(6.5 * columns, 4.2 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(rows, columns, squeeze=False).flatten()
    labels = sorted({label for lines in panels.values() for label in lines})
    colours = {label: f"C{number % 10}" for number, label in enumerate(labels)}
    for axes, (title, lines) in zip(grid, panels.items(), strict=False):
        where = (np.arange(BINS) + 1) * steps[title] / BINS
        for label, folders in lines.items():
            curves = np.array(
                [
                    binned_curve(curve_points(read_metrics(f / "metrics.jsonl")), steps[title])
                    for f in folders
                ]
            )
            name = f"{label} ({len(folders)} seed{'s' if len(folders) > 1 else ''})"
            axes.plot(where, curves.mean(0), color=colours[label], label=name)
            if len(folders) > 1:
                band = (curves.min(0), curves.max(0))
                axes.fill_between(where, *band, color=colours[label], alpha=0.15)
        axes.set_title(title)
        axes.set_xlabel("environment steps")
        axes.set_ylabel("true return, training episodes")
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.10g}"))
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    for axes in grid[len(panels) :]:
        axes.set_visible(False)
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=110)
    write_atomically(path, picture.getvalue())
