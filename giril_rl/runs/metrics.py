"""``metrics.jsonl``: a run's measurements, one JSON object a line."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from giril_rl.files.disk import name_file, write_atomically
from giril_rl.files.untrusted import parse_json

METRICS = "metrics.jsonl"
"""The file's name in a run's folder."""


def read_metrics(path: Path) -> list[dict[str, Any]]:
    r"""The rows of a ``metrics.jsonl``, oldest first; a line cut short by a kill is skipped.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "metrics.jsonl"
        >>> _ = path.write_text('{"phase": "ppo", "step": 512, "ppo/loss": 0.5}\n{"phase": "pp')
        >>> read_metrics(path)
        [{'phase': 'ppo', 'step': 512, 'ppo/loss': 0.5}]
    """
    if not path.exists():
        return []
    rows = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            row = parse_json(line)
        except ValueError:
            continue
        if isinstance(row, dict) and "phase" in row and type(row.get("step")) is int:
            rows.append(row)
    return rows


class MetricsFile:
    """Appends rows to ``metrics.jsonl``; each is in the file when :meth:`write` returns.

    Examples:
        >>> import tempfile
        >>> metrics = MetricsFile(Path(tempfile.mkdtemp()) / "metrics.jsonl")
        >>> metrics.write("ppo", 512, {"ppo/loss": 0.5})
        >>> metrics.write("ppo", 1024, {"ppo/loss": float("nan")})
        >>> metrics.truncate("ppo", 512)
        >>> read_metrics(metrics.path)
        [{'phase': 'ppo', 'step': 512, 'ppo/loss': 0.5}]
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if path.exists() and not _ends_a_line(path):
            self._rewrite(read_metrics(path))

    def write(self, phase: str, step: int, values: Mapping[str, float]) -> None:
        """Append one row. NaN and infinity, which JSON does not have, become null."""
        row: dict[str, Any] = {"phase": phase, "step": int(step)}
        for key, value in values.items():
            number = float(value)
            row[key] = number if math.isfinite(number) else None
        try:
            with open(self.path, "a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
        except OSError as error:
            name_file(error, self.path)
            raise

    def truncate(self, phase: str, step: int) -> None:
        """Drop the rows of ``phase`` after ``step``, and a line cut short by a kill."""
        if self.path.exists():
            rows = read_metrics(self.path)
            self._rewrite([r for r in rows if r.get("phase") != phase or r["step"] <= step])

    def _rewrite(self, rows: list[dict[str, Any]]) -> None:
        write_atomically(self.path, "".join(json.dumps(row) + "\n" for row in rows))


class MetricMeans:
    """Gathers the measurements of several batches for one row.

    Means are weighted; a single batch's measurements stay as they are, bit for bit.

    Args:
        totals: names of those that are added up rather than averaged.

    Examples:
        >>> means = MetricMeans(totals=["episodes"])
        >>> means.add({"loss": 1.0, "episodes": 1.0, "return": 5.0})
        >>> means.add({"loss": 2.0, "episodes": 3.0, "return": 9.0}, weights={"return": 3.0})
        >>> means.take()
        {'loss': 1.5, 'episodes': 4.0, 'return': 8.0}
        >>> means.take()
        {}
    """

    def __init__(self, *, totals: Collection[str] = ()) -> None:
        self._totals = totals
        self._values: dict[str, list[list[float]]] = {}

    def add(
        self, values: Mapping[str, float], *, weights: Mapping[str, float] | None = None
    ) -> None:
        """Adds one batch's measurements.

        Args:
            values: by name.
            weights: of those that do not weigh 1.
        """
        for name, value in values.items():
            self._values.setdefault(name, []).append([value, (weights or {}).get(name, 1.0)])

    def take(self) -> dict[str, float]:
        """Totals and means of what was added since the last time."""
        row = {name: self._one(name, pairs) for name, pairs in self._values.items()}
        self._values = {}
        return row

    def _one(self, name: str, pairs: list[list[float]]) -> float:
        if len(pairs) == 1:
            return pairs[0][0]
        if name in self._totals:
            return math.fsum(value for value, _ in pairs)
        total = math.fsum(weight for _, weight in pairs)
        return math.fsum(value * weight for value, weight in pairs) / total

    def state_dict(self) -> dict[str, Any]:
        """What was added and not taken yet."""
        return {"values": self._values}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restores what :meth:`state_dict` gave."""
        self._values = dict(state["values"])


def _ends_a_line(path: Path) -> bool:
    """Whether the last byte is a newline; reads only that byte."""
    with open(path, "rb") as file:
        file.seek(max(os.fstat(file.fileno()).st_size - 1, 0))
        return file.read() == b"\n"
