"""``metrics.jsonl``: a run's measurements, one JSON object a line."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
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


def _ends_a_line(path: Path) -> bool:
    """Whether the last byte is a newline; reads only that byte."""
    with open(path, "rb") as file:
        file.seek(max(os.fstat(file.fileno()).st_size - 1, 0))
        return file.read() == b"\n"
