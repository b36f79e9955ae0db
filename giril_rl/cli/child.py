"""A study's run in a process of its own, which ends when the study's process is gone.

``python -m giril_rl.cli.child WORDS`` does what ``giril WORDS`` does. Its standard input is a
pipe of which only the study's process has the other end: the system closes that end however the
process dies, also by ``kill -9``, when nothing can be sent any more.
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
        descriptor: the end of the pipe that is read; nothing is ever written to the other.
    """
    os.read(descriptor, 1)
    # Not sys.stderr: its buffer may be in the middle of a write.
    os.write(2, b"\nthe study's process is gone, so this run stops\n")
    os.kill(os.getpid(), gentle_signal())


if __name__ == "__main__":
    threading.Thread(target=watch, daemon=True).start()
    sys.exit(main())
