"""``giril study``: what the command does with its words."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from giril_rl.experiments.study.config import StudyConfig
from giril_rl.experiments.study.execute import Launcher, execute
from giril_rl.experiments.study.plan import Planner, StudyRun
from giril_rl.experiments.study.spec import find_study, read_spec
from giril_rl.experiments.study.status import StudyFolder
from giril_rl.files.disk import check_place


def settings_of(texts: Sequence[str]) -> tuple[StudyConfig, list[str]]:
    """A study's own settings among ``key=value`` texts, and the other texts.

    Raises:
        UserError: for a wrong type or value.

    Examples:
        >>> settings, others = settings_of(["jobs=2", "seed=0,1", "launcher=ray"])
        >>> settings.jobs, settings.launcher, others
        (2, 'ray', ['seed=0,1'])
    """
    from giril_rl.config.leaves import leaves
    from giril_rl.config.overrides import KeyCheck, parse
    from giril_rl.config.validation import validate

    settings, others = StudyConfig(), []
    known = {leaf.key for leaf in leaves(StudyConfig)}
    check = KeyCheck("giril study", StudyConfig, {})
    for override, text in zip(parse(texts), texts, strict=True):
        if override.get_key_element() in known:
            check.override(override)
            setattr(settings, override.get_key_element(), override.value())
        else:
            others.append(text)
    validate(settings)
    return settings, others


def run_study(
    name: str,
    texts: Sequence[str],
    command_line: Callable[[list[str]], int],
    *,
    dry_run: bool = False,
) -> int:
    """Make the runs of a study that have no result yet.

    Args:
        name: a shipped study's name or the path of a YAML file.
        texts: ``key=value``, the study's own settings and knobs of all its runs.
        command_line: what makes a run of its words, inside a worker of Ray.
        dry_run: only list the runs.

    Returns:
        The exit code: 0, or 1 where a run failed.

    Raises:
        UserError: before anything is started, for whatever is wrong with any run.
        KeyboardInterrupt: after Ctrl-C, once the runs have stopped.
    """
    spec = read_spec(find_study(name))
    settings, changes = settings_of(texts)
    check_place(Path(settings.root), "root=")
    study = StudyFolder(spec, changes, Planner(Path(settings.root)).plan(spec, changes))
    finished = study.count("finished")
    if dry_run:
        for run in study.runs:
            print(_line(study, run))
        print(f"{len(study.runs)} runs, {finished} of them finished.")
        return 0
    on_gpu = any(run.config.device == "cuda" for run in study.runs)
    launcher = _launcher(settings, command_line, on_gpu)
    at_once = settings.jobs or launcher.slots
    print(
        f"study {spec.name}: {len(study.runs)} runs, {finished} finished before, {at_once} at a "
        f"time; {study.path}",
        flush=True,
    )
    study.write_study()
    execute(study, launcher, settings)
    return _outcome(study)


def _line(study: StudyFolder, run: StudyRun) -> str:
    return f"{study.standings[run.name].state:<9} {run.label}: giril {' '.join(run.command)}"


def _launcher(
    settings: StudyConfig, command_line: Callable[[list[str]], int], on_gpu: bool
) -> Launcher:
    if settings.launcher == "ray":
        from giril_rl.experiments.study.on_ray import RayLauncher

        return RayLauncher(
            command_line, settings.ray_address, per_gpu=settings.per_gpu if on_gpu else None
        )
    from giril_rl.experiments.study.local import LocalLauncher, visible_gpus

    return LocalLauncher(
        [sys.executable, "-m", "giril_rl.cli.child"],
        visible_gpus() if on_gpu else [],
        per_gpu=settings.per_gpu,
    )


def _outcome(study: StudyFolder) -> int:
    finished, total = study.count("finished"), len(study.runs)
    failed = [run for run in study.runs if study.standings[run.name].state == "failed"]
    if failed:
        print(f"giril: {len(failed)} of {total} runs failed:", file=sys.stderr)
        for run in failed:
            standing = study.standings[run.name]
            print(f"  {run.label}: {run.name}: {standing.last_line}", file=sys.stderr)
            print(f"    {study.log(run)}", file=sys.stderr)
    if finished + len(failed) < total:
        raise KeyboardInterrupt(
            f"interrupted with {finished:,} of {total:,} runs finished: the same command continues"
        )
    print(f"{finished} of {total} runs are finished.")
    return 1 if failed else 0
