"""Runs as processes of this machine."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from giril_rl.study.child import gentle_signal
from giril_rl.study.logs import begin_log
from giril_rl.study.plan import StudyRun


class LocalLauncher:
    """Starts each run as a process of its own, its output in a log file.

    A process is the leader of its own group, so that Ctrl-C in the terminal reaches it only through
    :meth:`interrupt`. Should this process be killed, the runs save their state and stop: see
    :mod:`giril_rl.study.child`.
    """

    def __init__(self) -> None:
        self._running: dict[str, tuple[StudyRun, subprocess.Popen[bytes]]] = {}
        self._gently = gentle_signal()

    @property
    def slots(self) -> int:
        """How many runs this machine has cores for."""
        return (
            len(os.sched_getaffinity(0))
            if hasattr(os, "sched_getaffinity")
            else os.cpu_count() or 1
        )

    def start(self, run: StudyRun, log: Path) -> None:
        """Start a run; what it prints is added to ``log``."""
        begin_log(log, run.command)
        with open(log, "ab") as output:
            process = subprocess.Popen(
                [sys.executable, "-m", "giril_rl.study.child", *run.command],
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=subprocess.STDOUT,
                # Numerical libraries would each take all cores.
                env={"OMP_NUM_THREADS": str(run.config.threads), **os.environ},
                process_group=0,
            )
        self._running[run.name] = run, process

    def poll(self) -> list[tuple[StudyRun, int]]:
        """Runs that have ended since the last call, with their exit codes."""
        ended = [(run, process.poll()) for run, process in self._running.values()]
        found = [(run, code) for run, code in ended if code is not None]
        for run, _ in found:
            self._forget(self._running.pop(run.name)[1])
        return found

    def interrupt(self) -> None:
        """Ask all runs to save their state and stop."""
        for _, process in self._running.values():
            process.send_signal(self._gently)

    def kill(self) -> None:
        """Stop all runs at once."""
        for _, process in self._running.values():
            process.kill()

    def close(self) -> None:
        """Nothing is left running."""
        self.kill()
        for _, process in self._running.values():
            process.wait()
            self._forget(process)
        self._running.clear()

    def _forget(self, process: subprocess.Popen[bytes]) -> None:
        if process.stdin is not None:
            process.stdin.close()
