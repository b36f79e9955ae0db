"""``giril study``: make the runs of a study, or list them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from giril_rl.cli.parser import Parser
from giril_rl.errors import UserError
from giril_rl.experiments.study.spec import (
    StudyConfig,
    find_study,
    read_spec,
    shipped_studies,
)
from giril_rl.files.disk import check_place

if TYPE_CHECKING:
    from giril_rl.experiments.study.launchers import Launcher
    from giril_rl.experiments.study.status import StudyFolder

CommandLine = Callable[[list[str]], int]
"""Makes a run of the words after ``giril`` and returns the exit code."""


def study(argv: Sequence[str], description: str | None, command_line: CommandLine) -> int:
    """Does what the words after ``giril study`` ask for.

    Args:
        argv: the words.
        description: of the command, for its help.
        command_line: makes a run, inside a worker of Ray.
    """
    parser = Parser("giril study", description=description, add_help=False)
    parser.add_argument("words", nargs="*", metavar="STUDY [key=value ...]")
    parser.add_argument("--dry-run", action="store_true", help="only check and list the runs")
    parser.add_argument("-h", "--help", action="store_true")
    args = parser.parse_intermixed_args(argv)
    if args.help:
        print(study_help())
        return 0
    if not args.words:
        raise UserError("name a study: `giril study --help` shows them.")
    return run_study(args.words[0], args.words[1:], command_line, dry_run=args.dry_run)


def run_study(
    name: str, texts: Sequence[str], command_line: CommandLine, *, dry_run: bool = False
) -> int:
    """Make the runs of a study that have no result yet.

    Args:
        name: a shipped study's name or the path of a YAML file.
        texts: ``key=value``, the study's own settings and knobs of all its runs.
        command_line: makes a run, inside a worker of Ray.
        dry_run: only list the runs.

    Returns:
        The exit code: 0, or 1 where a run failed.

    Raises:
        UserError: before anything is started, for whatever is wrong with any run.
        KeyboardInterrupt: after Ctrl-C, once the runs have stopped.
    """
    from giril_rl.experiments.study.execute import execute
    from giril_rl.experiments.study.plan import Planner
    from giril_rl.experiments.study.status import StudyFolder

    spec = read_spec(find_study(name))
    settings, changes = settings_of(texts)
    check_place(Path(settings.root), "root=")
    folder = StudyFolder(spec, changes, Planner(Path(settings.root)).plan(spec, changes))
    finished = folder.count("finished")
    if dry_run:
        for run in folder.runs:
            state = folder.standings[run.name].state
            print(f"{state:<9} {run.label}: giril {' '.join(run.command)}")
        print(f"{len(folder.runs)} runs, {finished} of them finished.")
        return 0
    on_gpu = any(run.config.device == "cuda" for run in folder.runs)
    launcher = _launcher(settings, command_line, on_gpu)
    at_once = settings.jobs or launcher.slots
    print(
        f"study {spec.name}: {len(folder.runs)} runs, {finished} finished before, {at_once} at a "
        f"time; {folder.path}",
        flush=True,
    )
    folder.write_study()
    execute(folder, launcher, settings)
    return _outcome(folder)


def settings_of(texts: Sequence[str]) -> tuple[StudyConfig, list[str]]:
    """A study's own settings among ``key=value`` texts, and the other texts.

    Raises:
        UserError: for a wrong type or value.

    Examples:
        >>> settings, others = settings_of(["jobs=2", "seed=0,1", "launcher=ray"])
        >>> settings.jobs, settings.launcher, others
        (2, 'ray', ['seed=0,1'])
    """
    from giril_rl.config.overrides import KeyCheck, parse
    from giril_rl.config.validation import validate

    settings, others = StudyConfig(), []
    check = KeyCheck("giril study", StudyConfig, {})
    for override, text in zip(parse(texts), texts, strict=True):
        if override.get_key_element() in check.knobs:
            check.override(override)
            setattr(settings, override.get_key_element(), override.value())
        else:
            others.append(text)
    validate(settings)
    return settings, others


def _launcher(settings: StudyConfig, command_line: CommandLine, on_gpu: bool) -> Launcher:
    from giril_rl.experiments.study.launchers import LocalLauncher, RayLauncher, visible_gpus

    if settings.launcher == "ray":
        per_gpu = settings.per_gpu if on_gpu else None
        return RayLauncher(command_line, settings.ray_address, per_gpu=per_gpu)
    program = [sys.executable, "-m", "giril_rl.cli.child"]
    return LocalLauncher(program, visible_gpus() if on_gpu else [], per_gpu=settings.per_gpu)


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


def study_help() -> str:
    """The page of ``giril study --help``: the shipped studies, and a study's own settings.

    Examples:
        >>> "launcher" in study_help()
        True
    """
    from giril_rl.config.knobs import default_text, knobs

    page = ["giril study STUDY [key=value ...] [--dry-run]", ""]
    page.append("Make the runs that a study lists and that have no result yet, several at a time.")
    page.append("The same command continues an interrupted study; --dry-run lists its runs.")
    page += ["", "Studies (or the path of a YAML file of your own)"]
    studies = shipped_studies()
    for name, path in studies.items():
        try:
            title = read_spec(path).title
        except UserError as error:
            title = str(error)
        page.append(f"  {name:<{max(map(len, studies))}}  {title}")
    page += ["", "Settings (key, default, meaning)"]
    for knob in knobs(StudyConfig):
        value = default_text(getattr(StudyConfig(), knob.key))
        page.append(f"  {knob.key:<11}  {value:<5}  {knob.line}")
    page.append("Any other key=value takes the place of that knob in all groups, such as seed=0,1.")
    return "\n".join(page)
