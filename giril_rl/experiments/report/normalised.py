"""Scores between a random policy's, which is 0, and the player's, which is 1."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from giril_rl.experiments.report.runs import RunRecord
from giril_rl.experiments.report.settings import method_of, task_word

if TYPE_CHECKING:
    from giril_rl.experiments.report.rows import Panel


@dataclass(frozen=True)
class Scale:
    """The two ends of one task's scale.

    A score below the random policy's is negative, one above the player's is larger than 1, and the
    sign of the task's returns does not matter.

    Attributes:
        random: mean score of the task's runs of a random policy; None where there are none.
        players: score of the player of each seed.

    Examples:
        >>> Scale(-50.0, {0: -10.0}).between(-20.0, -10.0)
        0.75
        >>> Scale(20.0, {0: 20.0}).between(20.0, 20.0) is None  # Nothing lies between them.
        True
    """

    random: float | None
    players: Mapping[int, float]

    def between(self, score: float, player: float | None) -> float | None:
        """A score on the scale of one player; None where an end is missing, or none is above."""
        if self.random is None or player is None or player <= self.random:
            return None
        return (score - self.random) / (player - self.random)

    def player(self, run: RunRecord) -> float | None:
        """Score of a run's own player; that of its seed where it learned from no demonstration."""
        result = run.result or {}
        if result.get("expert_return_mean") is not None:
            return float(result["expert_return_mean"])
        return None if has_demonstration(run) else self.players.get(run.seed)

    def of_run(self, run: RunRecord) -> float | None:
        """A run's normalised score; an expert has none, for it is the scale's end itself."""
        if run.score is None or method_of(run) == "expert":
            return None
        return self.between(run.score, self.player(run))

    def of_runs(self, runs: Iterable[RunRecord]) -> list[float]:
        """The runs' normalised scores; empty where one of them has none."""
        found = [self.of_run(run) for run in runs]
        scores = [score for score in found if score is not None]
        return scores if len(scores) == len(found) else []


def has_demonstration(run: RunRecord) -> bool:
    """Whether a run learned from a demonstration."""
    result = run.result or {}
    return any(result.get(key) is not None for key in ("demo_transitions", "demo_id"))


def by_seed(runs: Iterable[RunRecord], key: str) -> dict[int, float]:
    """For each seed, the value of ``key`` that most results have."""
    found: dict[int, list[float]] = {}
    for run in runs:
        value = (run.result or {}).get(key)
        if value is not None:
            found.setdefault(run.seed, []).append(float(value))
    return {seed: max(each, key=each.count) for seed, each in sorted(found.items())}


def what_is_missing(panel: Panel) -> str:
    """Why runs of a task have no normalised score, and the command that gives what they lack.

    Empty where all have one.
    """
    runs = [run for row in panel.rows if row.method != "expert" for run in row.runs]
    without = [run for run in runs if panel.scale.of_run(run) is None]
    if not without:
        return ""
    low = panel.scale.random
    if low is None:
        command = _command(panel, "control", "reward=random")
        return f"Not normalised: a run of the random policy is missing; {command} makes one."
    unplayed = [run for run in without if panel.scale.player(run) is None]
    imported = [run for run in unplayed if has_demonstration(run)]
    texts = []
    if len(imported) < len(unplayed):
        seeds = sorted({run.seed for run in unplayed if run not in imported})
        command = _command(panel, "bc", *_seeds(seeds))
        texts.append(f"no run tells the score of the player of {_words(seeds)}; {command} does")
    if imported:
        texts.append(
            f"the demonstration of `{imported[0].name}`{_more(imported)} does not tell its "
            "player's score; write it into the demonstration's `card.json`, "
            '`"expert": {"return_mean": SCORE}`, and make the run again'
        )
    weak = [run for run in without if panel.scale.player(run) is not None]
    if weak:
        seeds = sorted({run.seed for run in weak})
        scores = sorted({f"{panel.scale.player(run):,.1f}" for run in weak})
        steps = weak[0].config.get("expert.steps") or weak[0].config.get("task.expert_steps")
        better = ["demo.path=null", f"expert.steps={2 * steps}"] if isinstance(steps, int) else []
        command = _command(panel, "bc", *_seeds(seeds), *better)
        texts.append(
            f"the player of {_words(seeds)} scores {' and '.join(scores)}, not more than the "
            f"random policy ({low:,.1f}); {command} trains it for longer"
        )
    return f"Not all are normalised: {'. Also, '.join(texts)}."


def _command(panel: Panel, recipe: str, *words: str) -> str:
    run = panel.rows[0].runs[0]
    texts = [task_word(run), *(f"{key}={value}" for key, value in panel.changes), *words]
    root = run.below.as_posix()
    texts += [f"root={root}"] if root != "runs" else []
    return f"`{shlex.join(['giril', 'run', recipe, *texts])}`"


def _seeds(seeds: Sequence[int]) -> list[str]:
    return [*(["-m"] if len(seeds) > 1 else []), f"seed={','.join(map(str, seeds))}"]


def _words(seeds: Sequence[int]) -> str:
    return f"seed{'s' if len(seeds) > 1 else ''} {', '.join(map(str, seeds))}"


def _more(runs: Sequence[RunRecord]) -> str:
    return f" and of {len(runs) - 1} more" if len(runs) > 1 else ""
