"""What stands behind the numbers: demonstrations and players, versions, processors."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

from giril_rl.experiments.report.normalised import has_demonstration
from giril_rl.experiments.report.runs import RunRecord
from giril_rl.experiments.report.tables import Table

UNKNOWN = "unknown"


def origins(run: RunRecord) -> tuple[Any, Any]:
    """What tells a run's demonstration and its player from others.

    Runs that were made before results had a ``demo_id`` had one demonstration each row.
    """
    result = run.result or {}
    player = (result.get("seeds", {}).get("expert"), result.get("expert_return_mean"))
    return result.get("demo_id") or UNKNOWN, player


def _covered(runs: Sequence[RunRecord]) -> str:
    """What an interval over these runs, of different seeds, covers."""
    demonstrations, players = (len(set(each)) for each in zip(*map(origins, runs), strict=True))
    seeds = len(runs)
    if demonstrations == 1:
        return (
            "one demonstration for all seeds, so that the interval does not cover the choice of "
            "the demonstration"
        )
    if players == demonstrations == seeds:
        return (
            "each seed has its own player and demonstration, so that the interval covers the "
            "choice of both"
        )
    if demonstrations == seeds and players == 1:
        return (
            "each seed has its own demonstration of one player, so that the interval does not "
            "cover the choice of the player"
        )
    return (
        f"{demonstrations} demonstrations of {players} player{'s' * (players > 1)} for {seeds} "
        "seeds, so that the interval covers their choice in part"
    )


def intervals_text(table: Table) -> str:
    """Whether a table's intervals cover the choice of player and demonstration, as a sentence.

    Empty where no row has both an interval and a demonstration.
    """
    found: dict[str, list[str]] = {}
    for line in table.lines:
        runs = [run for run in line.row.runs if has_demonstration(run)]
        if len(runs) > 1:
            name = f"{line.row.name} {line.value}".strip()
            found.setdefault(_covered(runs), []).append(name)
    if len(found) == 1:
        (text,) = found
        return f"{text[0].upper()}{text[1:]}."
    parts = [f"{', '.join(names)}: {text}" for text, names in found.items()]
    return f"{'; '.join(parts)}." if parts else ""


def made_with(runs: Iterable[RunRecord]) -> str:
    """Versions of the packages, and the processors, that made the runs; for the report's top."""
    results = [run.result or {} for run in runs]
    texts = []
    for name in ("giril_rl", "torch", "torchrl"):
        found = [(result.get("versions") or {}).get(name) for result in results]
        texts.append(f"{name.replace('_', '-')} {_counted(found)}")
    processors = [result.get("processor") for result in results]
    where = f"; processor: {_counted(processors)}" if any(processors) else ""
    return f"{', '.join(texts)}{where}"


def _counted(values: Sequence[str | None]) -> str:
    """The values, each with the number of its runs where there are several.

    Examples:
        >>> _counted(["0.2", "0.2"]), _counted(["0.2", None, "0.1"])
        ('0.2', '0.1 (1 run) and 0.2 (1 run) and unknown (1 run)')
    """
    counts = Counter(value or UNKNOWN for value in values)
    if len(counts) == 1:
        return next(iter(counts))
    order = sorted(counts, key=lambda value: (value == UNKNOWN, value))
    return " and ".join(f"{x} ({counts[x]} run{'s' * (counts[x] > 1)})" for x in order)
