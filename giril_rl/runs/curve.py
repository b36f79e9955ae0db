"""A run's curve, as ``curve.csv`` and ``curve.png``: of its returns, or of its losses.

Figures are matplotlib's own, not pyplot's: no window opens and no global state changes.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from giril_rl.files.disk import csv_text, write_atomically

SETS = ("fitted", "held_out")
_RETURN, _EPISODES = "train/return_mean", "train/episodes"


def curve_points(rows: Iterable[Mapping[str, Any]]) -> list[tuple[int, float, int | None]]:
    """(environment steps, mean return, episodes in that mean) of the rows that have a return.

    Args:
        rows: a run's metrics, see :func:`giril_rl.runs.metrics.read_metrics`.

    Examples:
        >>> curve_points([{"step": 512, "ppo/loss": 0.5}, {"step": 512, "train/return_mean": 21.0}])
        [(512, 21.0, None)]
    """
    return [
        (
            int(row["step"]),
            float(row[_RETURN]),
            None if row.get(_EPISODES) is None else int(row[_EPISODES]),
        )
        for row in rows
        if row.get(_RETURN) is not None
    ]


def loss_points(
    rows: Iterable[Mapping[str, Any]], phase: str = "bc"
) -> list[tuple[int, float, float | None]]:
    """(gradient steps, training loss, validation loss) of the rows of ``phase``.

    Examples:
        >>> loss_points([{"phase": "bc", "step": 100, "bc/fitted/loss": 0.5}])
        [(100, 0.5, None)]
    """
    fitted, held_out = (f"{phase}/{name}/loss" for name in SETS)
    return [
        (int(row["step"]), float(row[fitted]), row.get(held_out))
        for row in rows
        if row.get(fitted) is not None
    ]


def write_curve(
    folder: Path | str,
    rows: Iterable[Mapping[str, Any]],
    *,
    recipe: str,
    task: str,
    seed: int,
    expert_return: float | None = None,
    demo_return: float | None = None,
    final_return: float | None = None,
    final_std: float | None = None,
    final_step: int | None = None,
) -> tuple[Path, Path]:
    """Write the task's true score against environment steps.

    Args:
        folder: the folder of the two files.
        rows: the run's metrics; those with ``"train/return_mean"`` are drawn.
        recipe: the method's name, for the title.
        task: the task's name, for the title.
        seed: the run's seed, for the title.
        expert_return: the expert's mean score, a horizontal line.
        demo_return: the demonstration's mean score, a horizontal line.
        final_return: the mean score of the final evaluation, a marker.
        final_std: its standard deviation over episodes, the marker's error bar.
        final_step: the marker's place; None is the last step of the curve.

    Returns:
        The paths of ``curve.csv`` and ``curve.png``.

    Examples:
        >>> import tempfile
        >>> rows = [{"step": 1000, "train/return_mean": 21.5, "train/episodes": 40}]
        >>> table, picture = write_curve(
        ...     tempfile.mkdtemp(), rows, recipe="giril", task="cartpole", seed=0
        ... )
        >>> print(table.read_text().strip())
        step,return_mean,episodes
        1000,21.5,40
        >>> picture.name
        'curve.png'
    """
    points = curve_points(rows)
    figure = new_figure(8, 5)
    axes = figure.add_subplot()
    if points:
        steps, means, _ = zip(*points, strict=True)
        axes.plot(steps, means, marker="." if len(points) < 30 else None, label="training episodes")
    else:
        axes.text(0.5, 0.5, "no training episode ended", ha="center", transform=axes.transAxes)
    # Expert and demonstration often score the same: thick dots over a thin line show both.
    for value, name, style in (
        (expert_return, "expert", {"linestyle": "-", "linewidth": 1.2, "color": "tab:green"}),
        (demo_return, "demonstration", {"linestyle": ":", "linewidth": 2.4, "color": "tab:orange"}),
    ):
        if value is not None:
            axes.axhline(value, label=f"{name} ({value:,.1f})", **style)
    if final_return is not None:
        axes.errorbar(
            [final_step if final_step is not None else points[-1][0] if points else 0],
            [final_return],
            yerr=None if final_std is None else [final_std],
            marker="*",
            markersize=14,
            capsize=4,
            color="tab:red",
            linestyle="none",
            clip_on=False,
            zorder=5,
            label=f"final evaluation ({final_return:,.1f})",
        )
    axes.set_title(f"{recipe} on {task}, seed {seed}")
    axes.set_xlabel("environment steps")
    axes.set_ylabel("return of an episode (the task's own score)")
    thousands(axes.xaxis)
    thousands(axes.yaxis)
    return _write(folder, ["step", "return_mean", "episodes"], points, figure)


def write_losses(
    folder: Path | str,
    rows: Iterable[Mapping[str, Any]],
    *,
    recipe: str,
    task: str,
    seed: int,
    final_return: float,
) -> tuple[Path, Path]:
    """Write the losses of a run that learns without an environment against gradient steps.

    Arguments and result are those of :func:`write_curve`.

    Examples:
        >>> import tempfile
        >>> rows = [{"step": 100, "bc/fitted/loss": 0.5, "bc/held_out/loss": 0.75}]
        >>> table, picture = write_losses(
        ...     tempfile.mkdtemp(), rows, recipe="bc", task="pole", seed=0, final_return=990.2
        ... )
        >>> print(table.read_text().strip())
        step,fitted,held_out
        100,0.5,0.75
        >>> picture.name
        'curve.png'
    """
    points = loss_points(rows)
    figure = new_figure(8, 5)
    axes = figure.add_subplot()
    for column, name in enumerate(SETS, 1):
        pairs = [(point[0], point[column]) for point in points if point[column] is not None]
        if pairs:
            label = f"{name.replace('_', '-')} transitions"
            axes.plot(*zip(*pairs, strict=True), label=label)
    axes.set_yscale("log")
    axes.set_title(f"{recipe} on {task}, seed {seed}: final evaluation {final_return:,.1f}")
    axes.set_xlabel("gradient steps")
    axes.set_ylabel("loss")
    return _write(folder, ["step", *SETS], points, figure)


def _write(
    folder: Path | str, columns: list[str], points: list[Any], figure: Any
) -> tuple[Path, Path]:
    table, picture = Path(folder) / "curve.csv", Path(folder) / "curve.png"
    write_atomically(table, csv_text(columns, points))
    (axes,) = figure.axes
    axes.grid(alpha=0.3)
    if axes.get_legend_handles_labels()[0]:
        axes.legend()
    save(figure, picture)
    return table, picture


def new_figure(width: float, height: float) -> Any:
    """A matplotlib figure of this size in inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def thousands(axis: Any) -> None:
    """Write an axis's numbers in full, such as 1,000,000."""
    from matplotlib.ticker import FuncFormatter

    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.10g}"))


def save(figure: Any, path: Path) -> None:
    """Write the figure as PNG, atomically."""
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=120)
    write_atomically(path, picture.getvalue())
