"""Runs as tasks of a Ray cluster, whose machines share the folders with this one."""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from giril_rl.errors import INTERRUPTED, UserError
from giril_rl.experiments.study.logs import begin_log
from giril_rl.experiments.study.plan import StudyRun

KILLED = -9
"""The code of a run whose worker is gone: that of SIGKILL, which Windows does not name."""


class RayLauncher:
    """Hands each run to a Ray worker that does nothing else, its output in a log file.

    The run takes place in the worker itself rather than in a process below it: when a worker is
    killed, nothing stays behind that holds the run's folder.

    Args:
        command_line: what makes a run of its words and returns the exit code.
        address: the cluster's address, ``auto`` for one that runs on this machine.
        per_gpu: how many runs share a GPU; None where no run uses one.

    Raises:
        UserError: where Ray is not installed, no cluster answers, or it has no GPU for the runs.
    """

    def __init__(
        self,
        command_line: Callable[[list[str]], int],
        address: str,
        *,
        per_gpu: int | None = None,
    ) -> None:
        if importlib.util.find_spec("ray") is None:
            raise UserError(
                'launcher=ray needs the package ray: pip install "giril-rl[ray]", or leave it out.'
            )
        import ray

        self._ray = ray
        try:
            ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
        except (ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
            raise UserError(
                f"no Ray cluster answers at ray_address={address}: start one with "
                "`ray start --head`, or give its address."
            ) from error
        self._per_gpu = per_gpu
        self._command_line = command_line
        if per_gpu is not None and not self._resource("GPU"):
            ray.shutdown()
            raise UserError(
                f"device=cuda, and the Ray cluster at ray_address={address} has no GPU: leave "
                "device=cpu, or add a machine that has one."
            )
        # One run a process: `max_calls` ends the worker after it, as a command ends.
        self._remote = ray.remote(max_retries=0, max_calls=1)(run_in_worker)
        self._running: dict[Any, StudyRun] = {}

    @property
    def slots(self) -> int:
        """How many CPUs the cluster has at the moment, or places on its GPUs where runs use one."""
        cpus = int(self._resource("CPU"))
        if self._per_gpu is not None:
            cpus = min(cpus, int(self._resource("GPU")) * self._per_gpu)
        return max(cpus, 1)

    def _resource(self, name: str) -> float:
        return self._ray.cluster_resources().get(name, 0)

    def start(self, run: StudyRun, log: Path) -> None:
        """Hand a run to the cluster; what it prints is added to ``log``."""
        gpus = 1 / (self._per_gpu or 1) if run.config.device == "cuda" else 0
        task = self._remote.options(num_cpus=run.config.threads, num_gpus=gpus, name=run.name)
        reference = task.remote(
            self._command_line, run.command, str(log.absolute()), str(Path.cwd())
        )
        self._running[reference] = run

    def poll(self) -> list[tuple[StudyRun, int]]:
        """Runs that have ended since the last call, with their exit codes."""
        if not self._running:
            return []
        waiting = list(self._running)
        ended, _ = self._ray.wait(waiting, num_returns=len(waiting), timeout=0)
        return [(self._running.pop(reference), self._code(reference)) for reference in ended]

    def _code(self, reference: Any) -> int:
        errors = self._ray.exceptions
        try:
            return self._ray.get(reference)
        except errors.TaskCancelledError:
            return INTERRUPTED
        except errors.RayTaskError:
            return 1
        except errors.RayError:
            return KILLED

    def interrupt(self) -> None:
        """Ask all runs to save their state and stop."""
        self._cancel(force=False)

    def kill(self) -> None:
        """Stop all runs at once."""
        self._cancel(force=True)

    def close(self) -> None:
        """Leave the cluster, which ends what still runs there."""
        self._ray.shutdown()

    def _cancel(self, *, force: bool) -> None:
        for reference in self._running:
            # One that has ended in the meantime cannot be cancelled.
            with contextlib.suppress(self._ray.exceptions.RayError, ValueError):
                self._ray.cancel(reference, force=force)


def run_in_worker(
    command_line: Callable[[list[str]], int], command: list[str], log: str, folder: str
) -> int:
    """Make a run inside a Ray worker, as ``giril`` would, and return the exit code.

    Args:
        command_line: what makes it, given the words.
        command: the words after ``giril``.
        log: the file that the output is added to.
        folder: the working directory.
    """
    os.chdir(folder)
    begin_log(Path(log), command)
    with open(log, "a", buffering=1, encoding="utf-8") as output:
        # Both what Python prints and what a simulator writes to the bare descriptors.
        for descriptor in (1, 2):
            os.dup2(output.fileno(), descriptor)
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
            return command_line(command)
