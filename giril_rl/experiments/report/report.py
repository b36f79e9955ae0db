"""``giril report``: all runs below a folder as Markdown, CSV and PNG."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from giril_rl.experiments.report.captions import caption, made_with
from giril_rl.experiments.report.charts import draw_bars, draw_results, draw_varied
from giril_rl.experiments.report.entries import PLAYER, TRUE_REWARD
from giril_rl.experiments.report.learners import learner_and_reward
from giril_rl.experiments.report.pictures import draw_pictures
from giril_rl.experiments.report.reading import RunRecord, Unfinished, read_runs
from giril_rl.experiments.report.rows import Panel
from giril_rl.experiments.report.statistics import RESAMPLES
from giril_rl.experiments.report.tables import Table, panels_of, tables_of
from giril_rl.experiments.report.text import markdown, overall, results_csv, table_markdown
from giril_rl.files.disk import check_place, csv_text, write_atomically
from giril_rl.runs.identity import safe

_RUN_COLUMNS = (
    *("folder", "state", "method", "task", "profile", "seed", "reward_seed", "env_steps"),
    *("return_mean", "mode_return_mean", "episode_length_mean", "life_length_mean"),
    *("wall_seconds", "steps_per_second", "config_hash", "last_line"),
    *("demo", "demo_id", "expert_return_mean", "demo_return_mean", "normalised"),
)
_BESIDE_SAC = ("algorithm", "score_over_demo")
"""Columns of reports in which a run has SAC."""


def write_report(folder: Path, out: Path) -> str:
    """Write ``report.md``, ``results.csv``, ``runs.csv`` and the pictures.

    Returns one line that says what was written.

    Raises:
        UserError: if there is no finished run.
    """
    check_place(out, "--out")
    runs, unfinished = read_runs(folder)
    panels = panels_of(runs)
    tables = [tables_of(panel) for panel in panels]
    flat = [table for of_panel in tables for table in of_panel]
    out.mkdir(parents=True, exist_ok=True)
    sections = [_head(runs, unfinished)]
    if draw_bars(panels, out / "normalised.png"):
        sections.append("## All tasks\n\n![normalised scores](normalised.png)\n")
        sections.append(overall(panels))
    for panel, of_panel in zip(panels, tables, strict=True):
        sections += [_section(table, out) for table in of_panel]
        sections.append(learner_and_reward(panel))
    sections += draw_pictures(panels, out)
    sections += [_repeats(panels), _without_result(unfinished)]
    write_atomically(out / "report.md", "\n".join(text for text in sections if text))
    write_atomically(out / "results.csv", results_csv(flat))
    write_atomically(out / "runs.csv", _runs_csv(unfinished, panels))
    missing = f", {len(unfinished)} without a result" if unfinished else ""
    return f"{len(runs)} finished runs in {len(flat)} tables{missing}: {out / 'report.md'}"


def _head(runs: Sequence[RunRecord], unfinished: Sequence[Unfinished]) -> str:
    episodes = sorted({int(run.result["episodes"]) for run in runs})
    missing = (
        f" {len(unfinished)} runs have no result; they are [listed at the end](#without-a-result)."
        if unfinished
        else ""
    )
    has_sac = any(run.algorithm == "sac" for run in runs)
    sac = "; one that SAC trained takes its mean action" if has_sac else ""
    return (
        "# Results\n\n"
        f"{len(runs)} finished runs, made with {made_with(runs)}.{missing}\n\n"
        f"- **score**: the task's own return, the mean over {' or '.join(map(str, episodes))} "
        "whole episodes on fresh environments. The policy samples its actions, as in training"
        f"{sac}. `n` is the number of seeds, `steps` what the policy trained for.\n"
        "- **normalised**: (score - random) / (player - random). 0 is the mean score of a random "
        "policy on that task, 1 that of the player whose demonstration the run learned from. A run "
        "without a demonstration has the player of its seed.\n"
        "- **[low, high]**: 95% stratified percentile bootstrap interval over seeds "
        f"({RESAMPLES:,} resamples). With few seeds it is too narrow: read the seeds. The random "
        "policy's score counts as known.\n"
        "- **P(> best control)**: probability that a run of the method scores above a run of the "
        "control with the highest mean on that task at that budget; a draw counts one half. The "
        "control was chosen by these same runs.\n"
        "- **paper**: the paper's mean score. **Bold**: the best of the methods that imitate.\n\n"
        "Interquartile means, scores of each policy's most likely action, life lengths and speeds "
        "are in [results.csv](results.csv), all runs in [runs.csv](runs.csv).\n"
    )


def _section(table: Table, out: Path) -> str:
    title = table.panel.title
    heading = "##" if table.name == "results" else "###"
    text = [f"{heading} {title}: {table.title}\n", caption(table), table_markdown(table)]
    name = f"curves-{safe(title.replace(', ', '-'))}"
    name += "" if table.name == "results" else f"-{table.name}"
    draw = draw_results if table.name == "results" else draw_varied
    for path in draw(table, out / f"{name}.png"):
        text.append(f"![{table.title}, {title}]({path.name})\n")
    return "\n".join(text)


def _repeats(panels: Sequence[Panel]) -> str:
    repeats = [f"- `{run.name}`\n" for panel in panels for run in panel.repeats]
    if not repeats:
        return ""
    head = "## Repeated runs\n\nThese repeat a seed of a row above and are not counted.\n\n"
    return f"{head}{''.join(repeats)}"


def _without_result(unfinished: Sequence[Unfinished]) -> str:
    if not unfinished:
        return ""
    rows = [
        {"run": f"`{run.name}`", "state": run.state, "steps": run.steps, "last line": run.reason}
        for run in unfinished
    ]
    return f"## Without a result\n\n{markdown(rows)}"


def _runs_csv(unfinished: Sequence[Unfinished], panels: Sequence[Panel]) -> str:
    rows: dict[str, dict[str, Any]] = {}
    for panel in panels:
        for run in (*panel.runs, *panel.repeats):
            rows[run.name] = run.result | {
                "folder": run.name,
                "state": "finished",
                "method": PLAYER if run.method == TRUE_REWARD else run.method,
                "reward_seed": run.result.get("seeds", {}).get("reward"),
                "mode_return_mean": run.mode,
                "normalised": panel.normalised_run(run),
                "algorithm": run.algorithm,
                "score_over_demo": panel.over_demonstration_run(run),
            }
    ordered = [rows[name] for name in sorted(rows, key=Path)]
    ordered += [
        {"folder": run.name, "state": run.state, "last_line": run.reason} for run in unfinished
    ]
    columns = _RUN_COLUMNS + _BESIDE_SAC * any(panel.has_sac for panel in panels)
    return csv_text(columns, ([row.get(key) for key in columns] for row in ordered))
