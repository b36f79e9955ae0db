"""``giril report``: all runs below a folder as Markdown, CSV and PNG."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from giril_rl.experiments.report.bars import draw_bars
from giril_rl.experiments.report.curves import draw_results, draw_varied
from giril_rl.experiments.report.formats import (
    budget_text,
    markdown,
    reference_text,
    seeds_text,
    steps_text,
    to_csv,
)
from giril_rl.experiments.report.normalised import what_is_missing
from giril_rl.experiments.report.origins import intervals_text, made_with
from giril_rl.experiments.report.overall import overall
from giril_rl.experiments.report.pictures import draw_pictures
from giril_rl.experiments.report.rows import Panel, panels_of
from giril_rl.experiments.report.runs import RunRecord, Unfinished, read_runs
from giril_rl.experiments.report.statistics import RESAMPLES, load_rliable
from giril_rl.experiments.report.tables import Table, tables_of
from giril_rl.files.disk import check_place, csv_text, write_atomically
from giril_rl.runs.identity import safe

_RUN_COLUMNS = (
    "folder",
    "state",
    "method",
    "task",
    "profile",
    "seed",
    "reward_seed",
    "env_steps",
    "return_mean",
    "mode_return_mean",
    "episode_length_mean",
    "life_length_mean",
    "wall_seconds",
    "steps_per_second",
    "config_hash",
    "last_line",
    "demo",
    "demo_id",
    "expert_return_mean",
    "demo_return_mean",
    "normalised",
)


def write_report(folder: Path, out: Path) -> str:
    """Write ``report.md``, ``results.csv``, ``runs.csv`` and the pictures.

    Args:
        folder: where runs are, at any depth.
        out: where to write; made if need be.

    Returns:
        One line that says what was written.

    Raises:
        UserError: where there is no finished run, or rliable is missing.
    """
    load_rliable()
    check_place(out, "--out")
    runs, unfinished = read_runs(folder)
    panels = panels_of(runs)
    tables = [table for panel in panels for table in tables_of(panel)]
    out.mkdir(parents=True, exist_ok=True)
    bars = draw_bars(panels, out / "normalised.png")
    sections = [_head(runs, unfinished)]
    if bars:
        sections.append("## All tasks\n\n![normalised scores](normalised.png)\n")
        sections.append(overall(panels))
    sections += [_section(table, out) for table in tables]
    sections += draw_pictures(panels, out)
    sections += [_leftovers(panels), _without_result(unfinished)]
    write_atomically(out / "report.md", "\n".join(text for text in sections if text))
    write_atomically(out / "results.csv", to_csv(tables))
    write_atomically(out / "runs.csv", _runs_csv(runs, unfinished, panels))
    missing = f", {len(unfinished)} without a result" if unfinished else ""
    return f"{len(runs)} finished runs in {len(tables)} tables{missing}: {out / 'report.md'}"


def _head(runs: Sequence[RunRecord], unfinished: Sequence[Unfinished]) -> str:
    episodes = sorted({int(run.result["episodes"]) for run in runs if run.result})
    missing = (
        f" {len(unfinished)} runs have no result; they are [listed at the end](#without-a-result)."
        if unfinished
        else ""
    )
    return (
        "# Results\n\n"
        f"{len(runs)} finished runs, made with {made_with(runs)}.{missing}\n\n"
        f"- **score**: the task's own return, the mean over {' or '.join(map(str, episodes))} "
        "whole episodes on fresh environments. The policy samples its actions, as in training. "
        "`n` is the number of seeds, `steps` what the policy trained for.\n"
        "- **normalised**: (score - random) / (player - random). 0 is the mean score of a random "
        "policy on that task, 1 that of the player whose demonstration the run learned from. A run "
        "without a demonstration has the player of its seed.\n"
        "- **[low, high]**: 95% stratified bootstrap interval over seeds (rliable, "
        f"{RESAMPLES:,} resamples). With few seeds it is too narrow: read the seeds. The random "
        "policy's score counts as known.\n"
        "- **P(> best control)**: probability that a run of the method scores above a run of the "
        "control with the highest mean on that task at that budget; a draw counts one half. The "
        "control was chosen by these same runs.\n"
        "- **paper**: the paper's mean score. **Bold**: the best of the methods that imitate.\n\n"
        "Interquartile means, scores of each policy's most likely action, life lengths and speeds "
        "are in [results.csv](results.csv), all runs in [runs.csv](runs.csv).\n"
    )


def _section(table: Table, out: Path) -> str:
    panel = table.panel
    heading = "##" if table.name == "results" else "###"
    text = [f"{heading} {panel.title}: {table.title}\n"]
    text += [_caption(table), markdown(table)]
    name = f"curves-{safe(panel.title.replace(', ', '-'))}"
    if table.name == "results":
        drawn = draw_results(table, out / f"{name}.png")
    else:
        name += f"-{table.name}"
        drawn = draw_varied(table, out / f"{name}.png")
    if drawn:
        text.append(f"![{table.title}, {panel.title}]({name}.png)\n")
    return "\n".join(text)


def _caption(table: Table) -> str:
    panel, rows = table.panel, [line.row for line in table.lines]
    parts = [f"{seeds_text(rows)}, {budget_text(rows)}.", intervals_text(table)]
    random = panel.scale.random
    references = [
        f"{words} {reference_text(values)}"
        for words, values in (
            (panel.demonstration, panel.references("demo")),
            ("expert", panel.references("expert")),
            ("random policy", [] if random is None else [random]),
        )
        if values
    ]
    if references:
        words = " and of the ".join(
            filter(None, [", of the ".join(references[:-1]), references[-1]])
        )
        parts.append(f"Scores of the {words}.")
    if table.name == "results" or not panel.main:
        parts.append(what_is_missing(panel))
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


def _leftovers(panels: Sequence[Panel]) -> str:
    repeats = [run for panel in panels for run in panel.repeats]
    if not repeats:
        return ""
    lines = "\n".join(f"- `{run.name}`" for run in repeats)
    return (
        f"## Repeated runs\n\nThese repeat a seed of a row above and are not counted.\n\n{lines}\n"
    )


def _without_result(unfinished: Sequence[Unfinished]) -> str:
    if not unfinished:
        return ""
    lines = ["| run | state | steps | last line |", "|---|---|---|---|"]
    for run in unfinished:
        reason = run.reason.replace("|", "\\|")
        lines.append(f"| `{run.name}` | {run.state} | {run.steps or '-'} | {reason or '-'} |")
    return "## Without a result\n\n" + "\n".join(lines) + "\n"


def _runs_csv(
    runs: Sequence[RunRecord], unfinished: Sequence[Unfinished], panels: Sequence[Panel]
) -> str:
    scales = {
        run.name: panel.scale
        for panel in panels
        for run in (*(run for row in panel.rows for run in row.runs), *panel.repeats)
    }
    rows = []
    for run in runs:
        result = run.result or {}
        row = {key: result.get(key) for key in _RUN_COLUMNS}
        row["folder"], row["state"], row["method"] = run.name, "finished", run.method
        row["normalised"] = scales[run.name].of_run(run)
        row["reward_seed"] = result.get("seeds", {}).get("reward")
        row["mode_return_mean"] = (result.get("deterministic") or {}).get("return_mean")
        rows.append(row)
    for other in unfinished:
        rows.append({"folder": other.name, "state": other.state, "last_line": other.reason})
    return csv_text(_RUN_COLUMNS, ([row.get(key) for key in _RUN_COLUMNS] for row in rows))
