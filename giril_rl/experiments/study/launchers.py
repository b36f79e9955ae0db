"""Where a study's runs are made: processes of this machine, or a Ray cluster."""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import os
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

from giril_rl.errors import INTERRUPTED, UserError
from giril_rl.experiments.study.plan import StudyRun
from giril_rl.experiments.study.status import begin_log
from giril_rl.runs.interrupt import gentle_signal

KILLED = -9
"""The exit code of a run whose worker is gone: that of SIGKILL, which Windows does not name."""


class Launcher(Protocol):
    """Makes runs, in processes of this machine or on a cluster."""

    @property
    def slots(self) -> int:
        """The number of runs that it has room for."""

    def start(self, run: StudyRun, log: Path) -> None:
        """Start a run; what it prints is added to ``log``."""

    def poll(self) -> list[tuple[StudyRun, int]]:
        """Runs that have ended since the last call, with their exit codes."""

    def interrupt(self) -> None:
        """Ask all runs to save their state and stop."""

    def kill(self) -> None:
        """Stop all runs at once."""

    def close(self) -> None:
        """Leave nothing running."""


def visible_gpus() -> list[str]:
    """The GPUs that torch sees, named as in ``CUDA_VISIBLE_DEVICES``.

    Examples:
        >>> all(isinstance(gpu, str) for gpu in visible_gpus())
        True
    """
    import torch

    named = [name for name in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if name]
    return (named or [str(number) for number in range(torch.cuda.device_count())])[
        : torch.cuda.device_count()
    ]


class LocalLauncher:
    """Starts each run as a process of its own, its output in a log file.

    Each process leads a group of its own, so that Ctrl-C in the terminal reaches it only through
    :meth:`interrupt`. If this process is killed, the system closes the standard input of each.

    Args:
        program: the command of a process, to which a run's words are added. It must stop by itself
            once its standard input is closed.
        gpus: the GPUs for runs with ``device=cuda``, named as in ``CUDA_VISIBLE_DEVICES``; each run
            sees the one that the fewest others use.
        per_gpu: how many runs share a GPU.
    """

    def __init__(
        self, program: Sequence[str], gpus: Sequence[str] = (), *, per_gpu: int = 1
    ) -> None:
        self._program = list(program)
        self._gpus, self._per_gpu = list(gpus), per_gpu
        self._gpu_of: dict[str, str] = {}
        self._running: dict[str, tuple[StudyRun, subprocess.Popen[bytes]]] = {}
        self._gently = gentle_signal()

    @property
    def slots(self) -> int:
        """The number of cores, or of places on the GPUs if that is smaller."""
        cores = (
            len(os.sched_getaffinity(0))
            if hasattr(os, "sched_getaffinity")
            else os.cpu_count() or 1
        )
        return min(cores, len(self._gpus) * self._per_gpu) if self._gpus else cores

    def start(self, run: StudyRun, log: Path) -> None:
        """Start a run; what it prints is added to ``log``."""
        begin_log(log, run.command)
        with open(log, "ab") as output:
            process = subprocess.Popen(
                [*self._program, *run.command],
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=subprocess.STDOUT,
                # Numerical libraries would each take all cores.
                env={
                    "OMP_NUM_THREADS": str(run.config.threads),
                    **os.environ,
                    **self._gpu_for(run),
                },
                process_group=0,
            )
        self._running[run.name] = run, process

    def _gpu_for(self, run: StudyRun) -> dict[str, str]:
        if run.config.device != "cuda" or not self._gpus:
            return {}
        used = [self._gpu_of[name] for name in self._running if name in self._gpu_of]
        self._gpu_of[run.name] = min(self._gpus, key=used.count)
        return {"CUDA_VISIBLE_DEVICES": self._gpu_of[run.name]}

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
        """Kill what still runs."""
        self.kill()
        for _, process in self._running.values():
            process.wait()
            self._forget(process)
        self._running.clear()

    def _forget(self, process: subprocess.Popen[bytes]) -> None:
        if process.stdin is not None:
            process.stdin.close()


class RayLauncher:
    """Hands each run to a Ray worker that does nothing else, its output in a log file.

    The run takes place in the worker itself, not in a process below it: when a worker is killed,
    nothing is left that holds the run's folder. The machines must share the run's folders.

    Args:
        command_line: makes a run of its words and returns the exit code.
        address: the cluster's address; ``auto`` for one on this machine.
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
        """The number of CPUs of the cluster, or of places on its GPUs if that is smaller."""
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
        """Leave the cluster, which ends the runs there."""
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
        command_line: makes the run of its words.
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
