"""The curve of a run that learns without an environment: its loss against gradient steps."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from giril_rl.files.disk import csv_text, write_atomically
from giril_rl.runs.drawing import new_figure, save

SETS = ("fitted", "held_out")


def loss_points(
    rows: Iterable[Mapping[str, Any]], phase: str = "bc"
) -> list[tuple[int, float, float | None]]:
    """(gradient steps, loss on the fitted pairs, loss on the held-out ones) of a run's metrics.

    Args:
        rows: a run's metrics, see :func:`giril_rl.runs.metrics.read_metrics`.
        phase: the phase whose losses are meant.

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


def write_losses(
    folder: Path | str,
    rows: Iterable[Mapping[str, Any]],
    *,
    recipe: str,
    task: str,
    seed: int,
    final_return: float,
) -> tuple[Path, Path]:
    """Write ``curve.csv`` and ``curve.png``: the losses of cloning against gradient steps.

    Args:
        folder: where to.
        rows: the run's metrics.
        recipe: the method's name, for the title.
        task: the task's name, for the title.
        seed: the run's seed, for the title.
        final_return: the mean score of the evaluation at the end, for the title.

    Returns:
        The paths of the two files.

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
    folder = Path(folder)
    points = loss_points(rows)
    write_atomically(folder / "curve.csv", csv_text(["step", *SETS], points))

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
    axes.grid(alpha=0.3)
    if points:
        axes.legend()
    save(figure, folder / "curve.png")
    return folder / "curve.csv", folder / "curve.png"
