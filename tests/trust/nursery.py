"""Runs as forks of a process that has imported everything: a life costs no imports."""

import json
import os
import signal
import subprocess
import sys
import traceback
from pathlib import Path
from typing import NamedTuple


class Ended(NamedTuple):
    """How a process ended: its exit code (negative: a signal), its words, the points it passed."""

    code: int
    words: str
    points: int | None


class Nursery:
    """Starts ``giril`` commands.

    Args:
        folder: where their output is kept.
    """

    def __init__(self, folder):
        self.folder, self.started = folder, 0

    def __enter__(self):
        self.process = subprocess.Popen(
            [sys.executable, __file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )
        return self

    def __exit__(self, *error):
        self.process.kill()
        self.process.communicate()

    def start(self, words, **points):
        """Starts a command and returns its process id; ``points`` are those of Points."""
        self.started += 1
        self.log = self.folder / f"{self.started}.log"
        return self._ask(do="start", words=list(map(str, words)), log=str(self.log), points=points)

    def wait(self, pid):
        """How the command that was started last, or ``pid``, ended."""
        code, log = self._ask(do="wait", pid=pid)
        count = Path(f"{log}.points")
        points = int(count.read_text()) if count.exists() else None
        return Ended(code, Path(log).read_text(), points)

    def run(self, words, **points):
        """Starts a command and waits for it."""
        return self.wait(self.start(words, **points))

    def _ask(self, **order):
        self.process.stdin.write(json.dumps(order) + "\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())


def serve():
    answers = os.fdopen(os.dup(1), "w")
    import torch
    import torchrl.collectors  # noqa: F401

    import giril_rl.cli.study
    import giril_rl.runs.curve
    import giril_rl.training  # noqa: F401
    from giril_rl.envs.gym_api import silent_stdout

    with silent_stdout(stderr=True):
        import pybullet_envs_gymnasium  # noqa: F401
    torch.set_num_threads(1)
    logs = {}
    while line := sys.stdin.readline():
        order = json.loads(line)
        if order["do"] == "start":
            pid = os.fork()
            if pid == 0:
                live(order)
            logs[pid] = order["log"]
            answer = pid
        else:
            _, status = os.waitpid(order["pid"], 0)
            answer = os.waitstatus_to_exitcode(status), logs[order["pid"]]
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


def live(order):
    code = 70
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        log = os.open(order["log"], os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(log, 1)
        os.dup2(log, 2)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        from points import Points

        from giril_rl.cli.command_line import main

        points = Points(**order["points"]) if order["points"] else None
        if points is not None:
            points.install()
        code = main(order["words"])
        if points is not None:
            Path(order["log"] + ".points").write_text(str(points.count))
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


if __name__ == "__main__":
    serve()
