"""The paper's figures, to stand beside ours."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml


@dataclass(frozen=True)
class Figure:
    """One number of the paper.

    Attributes:
        value: the mean return.
        table: number of the table that it stands in.
        steps: environment steps of the policy's training there.
        seeds: number of seeds there.
    """

    value: float
    table: int
    steps: int
    seeds: int

    @property
    def source(self) -> str:
        """Where the number is from, for a caption."""
        return f"Table {self.table}, {self.steps:,} steps, {self.seeds} seeds"


@cache
def _tables() -> list[dict[str, Any]]:
    text = Path(__file__).with_name("paper.yaml").read_text(encoding="utf-8")
    return yaml.safe_load(text)["tables"]


def paper_figure(about: str, task: str, method: str, value: str | None = None) -> Figure | None:
    """What the paper has for a method on a task, None where it has nothing.

    Args:
        about: the kind of table: ``results``, or an ablation's name.
        task: the task's name.
        method: the method as ``result.json`` names it, or ``demonstration``.
        value: value of the ablation's knob; None for ``results``.

    Examples:
        >>> paper_figure("results", "inverted_pendulum", "giril")
        Figure(value=990.2, table=5, steps=10000000, seeds=3)
        >>> paper_figure("beta", "breakout", "giril", "0.9").value
        361.5
    """
    for table in _tables():
        if table["about"] == about:
            found = table["tasks"].get(task, {}).get(method)
            if value is not None and isinstance(found, dict):
                found = found.get(value)
            if isinstance(found, (int, float)):
                return Figure(float(found), table["number"], table["steps"], table["seeds"])
    return None
