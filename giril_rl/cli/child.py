"""``python -m giril_rl.cli.child WORDS``: ``giril WORDS`` as a child process of a study.

It stops when the study's process is gone. Its standard input is a pipe whose other end only the
study's process has: the system closes that end however the process dies, even by ``kill -9``.
"""

from __future__ import annotations

import os
import sys
import threading

from giril_rl.cli.command_line import main
from giril_rl.runs.interrupt import gentle_signal


def watch(descriptor: int = 0) -> None:
    """Waits for the pipe's other end to close, then asks this process to save its state and stop.

    Args:
        descriptor: the end of the pipe to read; nothing is ever written to the other.
    """
    os.read(descriptor, 1)
    # Not sys.stderr: its buffer may be in the middle of a write.
    os.write(2, b"\nthe study's process is gone, so this run stops\n")
    os.kill(os.getpid(), gentle_signal())


if __name__ == "__main__":
    threading.Thread(target=watch, daemon=True).start()
    sys.exit(main())
