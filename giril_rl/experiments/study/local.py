"""Runs as processes of this machine."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Sequence
from pathlib import Path

from giril_rl.experiments.study.logs import begin_log
from giril_rl.experiments.study.plan import StudyRun
from giril_rl.runs.interrupt import gentle_signal


def visible_gpus() -> list[str]:
    """The GPUs that torch sees, as ``CUDA_VISIBLE_DEVICES`` names them for a process below.

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

    A process is the leader of its own group, so that Ctrl-C in the terminal reaches it only through
    :meth:`interrupt`. Should this process be killed, the system closes the standard input of each.

    Args:
        program: what a process runs, with a run's words after it. It is to stop by itself once its
            standard input is closed.
        gpus: names of the GPUs for runs with ``device=cuda``, as ``CUDA_VISIBLE_DEVICES`` has them;
            each run sees the one that the fewest others use.
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
        """How many runs this machine has cores for, and room on its GPUs where runs use them."""
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
        """Nothing is left running."""
        self.kill()
        for _, process in self._running.values():
            process.wait()
            self._forget(process)
        self._running.clear()

    def _forget(self, process: subprocess.Popen[bytes]) -> None:
        if process.stdin is not None:
            process.stdin.close()
