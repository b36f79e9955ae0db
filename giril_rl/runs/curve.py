"""The learning curve of one run, as numbers and as a picture."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from giril_rl.files.disk import csv_text, write_atomically
from giril_rl.runs.drawing import new_figure, save, thousands

_RETURN, _EPISODES = "train/return_mean", "train/episodes"


def curve_points(rows: Iterable[Mapping[str, Any]]) -> list[tuple[int, float, int | None]]:
    """(environment steps, mean return, episodes in that mean) of the rows that have a return.

    Args:
        rows: a run's metrics, see :func:`giril_rl.runs.metrics.read_metrics`.

    Examples:
        >>> curve_points([{"step": 512, "ppo/loss": 0.5}, {"step": 512, "train/return_mean": 21.0}])
        [(512, 21.0, None)]
    """
    points = []
    for row in rows:
        if row.get(_RETURN) is not None:
            episodes = row.get(_EPISODES)
            count = None if episodes is None else int(episodes)
            points.append((int(row["step"]), float(row[_RETURN]), count))
    return points


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
    """Write ``curve.csv`` and ``curve.png``: the task's true score against environment steps.

    Args:
        folder: where to.
        rows: the run's metrics; those with ``"train/return_mean"`` are drawn.
        recipe: the method's name, for the title.
        task: the task's name, for the title.
        seed: the run's seed, for the title.
        expert_return: the expert's mean score, a horizontal line.
        demo_return: the demonstration's mean score, a horizontal line.
        final_return: the mean score of the evaluation at the end, a marker.
        final_std: its standard deviation over episodes, the marker's bar.
        final_step: where the marker stands; None is the last step of the curve.

    Returns:
        The paths of the two files.

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
    folder = Path(folder)
    points = curve_points(rows)
    text = csv_text(["step", "return_mean", "episodes"], points)
    write_atomically(folder / "curve.csv", text)

    figure = new_figure(8, 5)
    axes = figure.add_subplot()
    if points:
        steps, means, _ = zip(*points, strict=True)
        axes.plot(steps, means, marker="." if len(points) < 30 else None, label="training episodes")
    else:
        axes.text(0.5, 0.5, "no training episode ended", ha="center", transform=axes.transAxes)
    for value, style, name in (
        (expert_return, "-", "expert"),
        (demo_return, ":", "demonstration"),
    ):
        if value is not None:
            # The two are often equal: dots drawn over a thin line leave both to be seen.
            expert = name == "expert"
            axes.axhline(
                value,
                linestyle=style,
                linewidth=1.2 if expert else 2.4,
                color="tab:green" if expert else "tab:orange",
                label=f"{name} ({value:,.1f})",
            )
    if final_return is not None:
        where = final_step if final_step is not None else (points[-1][0] if points else 0)
        axes.errorbar(
            [where],
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
    axes.grid(alpha=0.3)
    if axes.get_legend_handles_labels()[0]:
        axes.legend()
    save(figure, folder / "curve.png")
    return folder / "curve.csv", folder / "curve.png"
