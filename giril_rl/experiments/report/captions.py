"""What a caption says of a table: seeds, references, origins, and what is missing."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

from giril_rl.experiments.report.entries import PLAYER
from giril_rl.experiments.report.reading import RunRecord
from giril_rl.experiments.report.rows import Panel
from giril_rl.experiments.report.settings import task_words
from giril_rl.experiments.report.tables import Table
from giril_rl.experiments.report.text import budget_text, number, seeds_text, steps_text

UNKNOWN = "unknown"


def caption(table: Table) -> str:
    """The paragraph above a table."""
    panel, rows = table.panel, [line.row for line in table.lines]
    parts = [f"{seeds_text(rows)}, {budget_text(rows)}.", intervals_text(table)]
    references = [
        f"{words} {_reference(values)}"
        for words, values in (
            (panel.demonstration, panel.references("demo")),
            ("expert", panel.references("expert")),
            ("random policy", [] if panel.random is None else [panel.random]),
        )
        if values
    ]
    if references:
        *others, last = references
        words = ", of the ".join(others)
        parts.append(f"Scores of the {f'{words} and of the {last}' if others else last}.")
    if table.name == "results" or not panel.main:
        parts.append(what_is_missing(panel))
    if any(line.over_demonstration for line in table.lines):
        parts.append(
            "Over demonstration: the score divided by the return of that seed's demonstration; "
            "empty where a seed's score is negative or its demonstration's return not above zero."
        )
    controls = [line.improvement[1] for line in table.lines if line.improvement]
    if controls:
        names = {f"{row.name.removeprefix('control: ')} ({steps_text(row)})" for row in controls}
        parts.append(f"Best control at its budget of steps: {'; '.join(sorted(names))}.")
    sources = sorted({line.paper.source for line in table.lines if line.paper})
    if sources:
        parts.append(f"Paper: {'; '.join(sources)}.")
    if panel.shared:
        shared = " ".join(f"{key}={value}" for key, value in panel.shared)
        parts.append(f"All runs have `{shared}`.")
    if any(key == "task.horizon" for key, _ in panel.changes):
        parts.append("Curves are of training episodes; scores are of episodes that a failure ends.")
    return " ".join(part for part in parts if part) + "\n"


def _reference(values: Sequence[float]) -> str:
    """A score to compare with: the mean, and the range if seeds have their own.

    Examples:
        >>> _reference([900.0]), _reference([900.0, 1000.0])
        ('900.0', '950.0 (mean of 2, 900.0 to 1,000.0)')
    """
    mean = number(sum(values) / len(values))
    if len(values) == 1:
        return mean
    return f"{mean} (mean of {len(values)}, {number(min(values))} to {number(max(values))})"


def intervals_text(table: Table) -> str:
    """Whether a table's intervals cover the choice of player and demonstration, as a sentence.

    Empty if no row has both an interval and a demonstration.
    """
    found: dict[str, list[str]] = {}
    for line in table.lines:
        runs = [run for run in line.row.runs if run.has_demonstration]
        if len(runs) > 1:
            name = f"{line.row.name} {line.value}".strip()
            found.setdefault(_covered(runs), []).append(name)
    if len(found) == 1:
        (text,) = found
        return f"{text[0].upper()}{text[1:]}."
    parts = [f"{', '.join(names)}: {text}" for text, names in found.items()]
    return f"{'; '.join(parts)}." if parts else ""


def _origins(run: RunRecord) -> tuple[Any, Any]:
    """What identifies a run's demonstration, and its player.

    Results that are older than ``demo_id`` had one demonstration for each row.
    """
    player = run.result.get("seeds", {}).get("expert"), run.result.get("expert_return_mean")
    return run.result.get("demo_id") or UNKNOWN, player


def _covered(runs: Sequence[RunRecord]) -> str:
    """What an interval over these runs, of different seeds, covers."""
    demonstrations, players = (len(set(each)) for each in zip(*map(_origins, runs), strict=True))
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


def made_with(runs: Iterable[RunRecord]) -> str:
    """Versions of the packages, and the processors, that made the runs."""
    results = [run.result for run in runs]
    texts = []
    for name in ("giril_rl", "torch", "torchrl"):
        found = [(result.get("versions") or {}).get(name) for result in results]
        texts.append(f"{name.replace('_', '-')} {_counted(found)}")
    processors = [result.get("processor") for result in results]
    where = f"; processor: {_counted(processors)}" if any(processors) else ""
    return f"{', '.join(texts)}{where}"


def _counted(values: Sequence[str | None]) -> str:
    """The values, each with the number of its runs if there are several.

    Examples:
        >>> _counted(["0.2", "0.2"]), _counted(["0.2", None, "0.1"])
        ('0.2', '0.1 (1 run) and 0.2 (1 run) and unknown (1 run)')
    """
    counts = Counter(value or UNKNOWN for value in values)
    if len(counts) == 1:
        return next(iter(counts))
    order = sorted(counts, key=lambda value: (value == UNKNOWN, value))
    return " and ".join(f"{x} ({counts[x]} run{'s' * (counts[x] > 1)})" for x in order)


def what_is_missing(panel: Panel) -> str:
    """Why runs of a task have no normalised score, and the command that makes what they lack.

    Empty if all have one.
    """
    runs = [run for run in panel.runs if run.method != PLAYER]
    without = [run for run in runs if panel.normalised_run(run) is None]
    if not without:
        return ""
    if panel.random is None:
        command = _command(panel, "control", "reward=random")
        return f"Not normalised: a run of the random policy is missing; {command} makes one."
    unplayed = [run for run in without if panel.player(run) is None]
    imported = [run for run in unplayed if run.has_demonstration]
    weak = [run for run in without if panel.player(run) is not None]
    texts = []
    if len(imported) < len(unplayed):
        seeds = sorted({run.seed for run in unplayed if not run.has_demonstration})
        command = _command(panel, "bc", *_seeds(seeds))
        texts.append(f"no run tells the score of the player of {_words(seeds)}; {command} does")
    if imported:
        more = f" and of {len(imported) - 1} more" if len(imported) > 1 else ""
        texts.append(
            f"the demonstration of `{imported[0].name}`{more} does not tell its "
            "player's score; write it into the demonstration's `card.json`, "
            '`"expert": {"return_mean": SCORE}`, and make the run again'
        )
    if weak:
        seeds = sorted({run.seed for run in weak})
        scores = sorted({number(panel.player(run)) for run in weak})
        steps = weak[0].config.get("expert.steps") or weak[0].config.get("task.expert_steps")
        better = ["demo.path=null", f"expert.steps={2 * steps}"] if isinstance(steps, int) else []
        command = _command(panel, "bc", *_seeds(seeds), *better)
        texts.append(
            f"the player of {_words(seeds)} scores {' and '.join(scores)}, not more than the "
            f"random policy ({number(panel.random)}); {command} trains it for longer"
        )
    return f"Not all are normalised: {'. Also, '.join(texts)}."


def _command(panel: Panel, recipe: str, *words: str) -> str:
    run = panel.runs[0]
    texts = [*task_words(run, recipe, panel.changes), *words]
    root = run.below.as_posix()
    texts += [f"root={root}"] if root != "runs" else []
    return f"`{shlex.join(['giril', 'run', recipe, *texts])}`"


def _seeds(seeds: Sequence[int]) -> list[str]:
    return [*(["-m"] if len(seeds) > 1 else []), f"seed={','.join(map(str, seeds))}"]


def _words(seeds: Sequence[int]) -> str:
    return f"seed{'s' if len(seeds) > 1 else ''} {', '.join(map(str, seeds))}"
