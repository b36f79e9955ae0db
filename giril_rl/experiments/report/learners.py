"""The table "Learner and reward": the same rewards with either algorithm at the same budget."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from giril_rl.experiments.report.entries import PLAYER
from giril_rl.experiments.report.rows import Panel, Row
from giril_rl.experiments.report.text import markdown, seeds_text, with_interval

ALGORITHMS = ("ppo", "sac")
FEWEST = 2
"""Methods that imitate, each with both algorithms, below which there is no table."""


def twins(panel: Panel) -> dict[int, list[dict[str, Row]]]:
    """The rows that both algorithms have, by budget: for each method ``{algorithm: row}``.

    Both have the same settings. Controls are left out, rows with other settings of an algorithm
    itself, and budgets at which fewer than two methods imitate with both.
    """
    found: dict[int, dict[tuple[Any, ...], dict[str, Row]]] = {}
    for row in panel.rows:
        own = not any(key.startswith(("ppo.", "sac.")) for key, _ in row.changes)
        if row.algorithm in ALGORITHMS and own and not row.is_control and row.method != PLAYER:
            kinds = found.setdefault(row.steps, {})
            kinds.setdefault((row.method, row.profile, row.changes), {})[str(row.algorithm)] = row
    both = {
        steps: [pair for pair in kinds.values() if len(pair) == len(ALGORITHMS)]
        for steps, kinds in sorted(found.items())
    }
    return {
        steps: pairs
        for steps, pairs in both.items()
        if len({row.method for pair in pairs for row in pair.values() if row.is_learned}) >= FEWEST
    }


def learner_and_reward(panel: Panel) -> str:
    """The section of Markdown with a table for each budget; empty if there is none."""
    sections = [_table(panel, steps, pairs) for steps, pairs in twins(panel).items()]
    if not sections:
        return ""
    return "\n".join([f"### {panel.title}: learner and reward\n", *sections])


def _table(panel: Panel, steps: int, pairs: list[dict[str, Row]]) -> str:
    controls = {name: panel.best_control_at(steps, name) for name in ALGORITHMS}
    learned = [row for pair in pairs for row in pair.values() if row.is_learned]
    best = max(round(row.estimates[0].value, 1) for row in learned)
    lines = [
        {"reward": _name(pair)} | {key: _cell(row, best) for key, row in pair.items()}
        for pair in pairs
    ]
    if any(controls.values()):
        lines.append(
            {"reward": "best control"} | {key: _control(controls[key]) for key in controls}
        )
    rows = [row for pair in pairs for row in pair.values()]
    rows += [row for row in controls.values() if row is not None]
    text = (
        f"Mean scores of the same rewards with either learner after {steps:,} environment steps, "
        f"{seeds_text(rows)}, with 95% intervals: compare rows to see what the reward does, and "
        "columns to see what the learner does.\n"
    )
    return f"{text}\n{markdown([_titled(line) for line in lines])}"


def _name(pair: Mapping[str, Row]) -> str:
    row = pair["ppo"]
    return f"{row.name_of_both}, {row.settings}" if row.settings else row.name_of_both


def _titled(line: Mapping[str, str]) -> dict[str, str]:
    return {key.upper() if key in ALGORITHMS else key: line[key] for key in ("reward", *ALGORITHMS)}


def _cell(row: Row, best: float) -> str:
    is_best = row.is_learned and round(row.estimates[0].value, 1) == best
    return ("**{}**" if is_best else "{}").format(with_interval(row.estimates[0]))


def _control(row: Row | None) -> str:
    if row is None:
        return ""
    return f"{with_interval(row.estimates[0])}: {row.name_of_both.removeprefix('control: ')}"
