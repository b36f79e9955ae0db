"""The loop that makes a study's runs, several at a time; it survives killed runs and Ctrl-C."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from types import FrameType

from filelock import FileLock, Timeout

from giril_rl.errors import INTERRUPTED
from giril_rl.experiments.study.launchers import Launcher
from giril_rl.experiments.study.plan import StudyRun
from giril_rl.experiments.study.spec import StudyConfig
from giril_rl.experiments.study.status import StudyFolder, last_line
from giril_rl.runs.progress import progress

PAUSE = 0.1  # Seconds between polls.


class Signals:
    """Counts SIGINT and SIGTERM instead of letting them end the process."""

    def __init__(self) -> None:
        self.count = 0

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.count += 1
        if self.count == 1:
            # Not sys.stderr: its buffer may be in the middle of a write.
            os.write(2, b"\nstopping once the runs have saved their state; again to kill them\n")

    @contextlib.contextmanager
    def caught(self) -> Iterator[None]:
        """Counts inside the block; a signal that was ignored stays ignored."""
        numbers = [
            number
            for number in (signal.SIGINT, signal.SIGTERM)
            if signal.getsignal(number) not in (signal.SIG_IGN, None)
        ]
        before = {number: signal.signal(number, self._handle) for number in numbers}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def execute(study: StudyFolder, launcher: Launcher, settings: StudyConfig) -> None:
    """Make all runs that have no result yet; ``study.standings`` says how each ended.

    Experts go first. A run whose process was killed starts again and resumes, up to
    ``settings.retries`` times. The study waits for a run that another process is making. The first
    Ctrl-C lets the runs save their state, the second kills them.

    Args:
        study: the study; its status files are written whenever something changes.
        launcher: makes the runs; closed at the end.
        settings: the study's own settings.
    """
    waiting = [run for run in study.runs if not run.finished]
    running: dict[str, tuple[StudyRun, float]] = {}
    signals, told = Signals(), 0
    done = len(study.runs) - len(waiting)
    with (
        contextlib.closing(launcher),
        signals.caught(),
        progress(len(study.runs), done, f"study {study.spec.name}", unit="runs") as bar,
    ):
        study.write_status()
        while running or (waiting and not signals.count):
            changed = False
            room = (settings.jobs or launcher.slots) - len(running)
            if room > 0 and not signals.count:
                for run in islice(startable(waiting, [run for run, _ in running.values()]), room):
                    standing = study.standings[run.name]
                    standing.attempts += 1
                    standing.state, standing.last_line = "running", None
                    launcher.start(run, study.log(run))
                    running[run.name] = run, time.monotonic()
                    changed = True
                waiting = [run for run in waiting if run.name not in running]
            for run, code in launcher.poll():
                seconds = time.monotonic() - running.pop(run.name)[1]
                if _ended(study, run, code, seconds, settings, stopped=signals.count > 0):
                    waiting.insert(0, run)
                elif study.standings[run.name].state != "interrupted":
                    bar.update()
                changed = True
            for run in [run for run in waiting if run.finished]:  # By another process.
                waiting.remove(run)
                study.standings[run.name].state = "finished"
                bar.update()
                changed = True
            if changed:
                study.write_status()
            if signals.count > told:
                if told == 0:
                    launcher.interrupt()
                if signals.count > 1:
                    launcher.kill()
                told = signals.count
            bar.update(0, running=len(running), failed=study.count("failed"))
            time.sleep(PAUSE)


def startable(waiting: Sequence[StudyRun], running: Sequence[StudyRun]) -> Iterator[StudyRun]:
    """Runs that may start, experts first; the others wait for the experts of their task."""
    experts = [run for run in (*waiting, *running) if run.goes_first]
    expected = {run.config.task.name for run in experts}
    for run in sorted(waiting, key=lambda run: not run.goes_first):
        if (run.goes_first or run.config.task.name not in expected) and not in_use(run.folder):
            yield run


def in_use(folder: Path) -> bool:
    """Whether another process is making the run in ``folder``."""
    if not folder.is_dir():
        return False
    try:
        with FileLock(str(folder / ".lock"), timeout=0):
            return False
    except Timeout:
        return True


def _ended(
    study: StudyFolder,
    run: StudyRun,
    code: int,
    seconds: float,
    settings: StudyConfig,
    *,
    stopped: bool,
) -> bool:
    """Records how a run's process ended, and tells whether to start the run again."""
    standing = study.standings[run.name]
    standing.exit_code, standing.seconds = code, round(seconds, 1)
    if code == 0 and run.finished:
        standing.state = "finished"
        return False
    if code < 0 and not stopped and standing.attempts <= settings.retries:
        standing.state = "waiting"
        return True
    standing.state = "interrupted" if stopped or code == INTERRUPTED else "failed"
    standing.last_line = last_line(study.log(run))
    if code == 0:
        standing.last_line = f"ended without a result.json; {standing.last_line}"
    elif code < 0:
        standing.last_line = f"killed by signal {-code}; {standing.last_line}"
    return False
