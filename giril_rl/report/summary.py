"""Many finished runs as one table: every seed, the mean and its 95% interval.

python -m giril_rl.report.summary runs --csv scores.csv --png curves.png
"""

from __future__ import annotations

import argparse
import csv
import io
import sys
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from giril_rl.files import read_json, write_atomically
from giril_rl.report.curves import draw_curves

COLUMNS = ("task", "run", "steps", "seeds", "mean", "low", "high", "deterministic", "each seed")


@dataclass(frozen=True)
class Row:
    """Runs that differ in their seed alone."""

    task: str
    run: str
    steps: int
    seeds: tuple[int, ...]
    returns: tuple[float, ...]
    deterministic: tuple[float, ...]
    folders: tuple[Path, ...] = ()

    @property
    def cells(self) -> list[str]:
        """The row's texts, in the order of :data:`COLUMNS`."""
        low, high = interval(self.returns)
        return [
            self.task,
            self.run,
            f"{self.steps:,}",
            " ".join(str(seed) for seed in self.seeds),
            f"{np.mean(self.returns):,.1f}",
            f"{low:,.1f}",
            f"{high:,.1f}",
            f"{np.mean(self.deterministic):,.1f}",
            " ".join(f"{value:,.1f}" for value in self.returns),
        ]


def interval(values: Sequence[float], *, resamples: int = 10_000) -> tuple[float, float]:
    """Percentile bootstrap of the mean, 95%; with one value, that value twice.

    With three to five seeds such an interval is narrow rather than wide: read the seeds themselves.

    Examples:
        >>> interval([1000.0, 1000.0, 1000.0])
        (1000.0, 1000.0)
    """
    drawn = np.random.default_rng(0).choice(np.asarray(values, float), (resamples, len(values)))
    low, high = np.quantile(drawn.mean(1), [0.025, 0.975])
    return float(low), float(high)


def collect(folders: Iterable[Path]) -> list[Row]:
    """Rows of all finished runs below ``folders``, grouped by the folder above ``seedN``."""
    groups: dict[Path, dict[Path, dict[str, Any]]] = defaultdict(dict)
    for folder in folders:
        for path in sorted(folder.rglob("result.json")):
            groups[path.parent.parent][path.parent] = read_json(path)
    rows = []
    for place, runs in groups.items():
        runs = dict(sorted(runs.items(), key=lambda run: run[1]["seed"]))
        results = list(runs.values())
        rows.append(
            Row(
                task=results[0]["task"],
                run=f"{results[0]['method']} {place.name}",
                steps=results[0]["env_steps"],
                seeds=tuple(result["seed"] for result in results),
                returns=tuple(result["return_mean"] for result in results),
                deterministic=tuple(result["deterministic"]["return_mean"] for result in results),
                folders=tuple(runs),
            )
        )
    return sorted(rows, key=lambda row: (row.task, row.steps, row.run))


def markdown(rows: Sequence[Row]) -> str:
    """The table as Markdown.

    Examples:
        >>> row = Row("t", "giril default", 10, (0, 1), (1.0, 3.0), (1.0, 2.0))
        >>> print(markdown([row]).splitlines()[-1])
        | t | giril default | 10 | 0 1 | 2.0 | 1.0 | 3.0 | 1.5 | 1.0 3.0 |
    """
    lines = [COLUMNS, ["---"] * len(COLUMNS), *(row.cells for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def main(argv: Sequence[str] | None = None) -> None:
    """Print the table of all finished runs below some folders, and write it as CSV."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--csv", type=Path, help="file to write the table to besides")
    parser.add_argument("--png", type=Path, help="file to draw the learning curves in")
    args = parser.parse_args(argv)
    rows = collect(args.folders)
    sys.stdout.write(markdown(rows))
    if args.csv is not None:
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([COLUMNS, *(row.cells for row in rows)])
        write_atomically(args.csv, text.getvalue())
    if args.png is not None:
        panels: dict[str, dict[str, tuple[Path, ...]]] = defaultdict(dict)
        steps = {}
        for row in rows:
            title = f"{row.task}, {row.steps:,} steps"
            panels[title][row.run] = row.folders
            steps[title] = row.steps
        draw_curves(panels, steps, args.png)


if __name__ == "__main__":
    main()
