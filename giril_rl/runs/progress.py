"""Progress: tqdm's bar in a terminal, one whole line now and then in a log."""

from __future__ import annotations

import sys
import threading
from typing import Any, TextIO

from tqdm import tqdm


class _Lines:
    """A stream for tqdm that turns each refresh of the bar into a line of its own."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> None:
        if text.strip():
            self._stream.write(f"{text.strip()}\n")

    def flush(self) -> None:
        self._stream.flush()


class progress(tqdm):
    """A progress bar with the rate and the time left.

    A terminal gets tqdm's bar. Any other stream, such as a file or a batch system's log, gets one
    line at most every ``interval`` seconds, and nothing for work shorter than that.

    Args:
        total: steps of the whole work, those of earlier processes included.
        initial: steps done by earlier processes; they count in the bar but not in the rate.
        desc: the work's name.
        unit: what a step is called.
        interval: seconds between two lines if there is no terminal.
        stream: where to write; None is ``sys.stderr``.
        disable: only count, in ``n``.

    Examples:
        >>> import io
        >>> log = io.StringIO()
        >>> with progress(400, 100, "policy", interval=0.0, stream=log) as bar:
        ...     bar.update(300, loss=0.25)
        >>> print(log.getvalue())  # doctest: +ELLIPSIS
        policy: 25%|...| 100/400 [...steps/s]
        policy: 100%|...| 400/400 [...steps/s, loss=0.25]...
    """

    monitor_interval = 0  # No thread: with miniters=1 each update looks at the clock.

    def __init__(
        self,
        total: int,
        initial: int = 0,
        desc: str = "",
        *,
        unit: str = "steps",
        interval: float = 30.0,
        stream: TextIO | None = None,
        disable: bool = False,
    ) -> None:
        stream = sys.stderr if stream is None else stream
        self._is_log = not stream.isatty()
        form: dict[str, Any] = (
            {"file": _Lines(stream), "mininterval": interval, "delay": interval}
            | {"ncols": 100, "ascii": True, "smoothing": 0}  # The average rate.
            if self._is_log
            else {"file": stream, "dynamic_ncols": True}
        )
        form |= {"desc": desc, "unit": f" {unit}", "miniters": 1}
        super().__init__(total=total, initial=initial, disable=disable, **form)

    def update(self, steps: int = 1, **values: float | str) -> None:
        """Count ``steps`` more and show ``values``, such as a loss, after the rate."""
        if self.disable:
            self.n += steps
            return
        if values:
            self.set_postfix(values, refresh=False)
        super().update(steps)

    def close(self) -> None:
        """End the bar; a log gets a last line unless it has that line already."""
        if self._is_log and not self.disable and self.n == self.last_print_n:
            self.leave = False
        super().close()


# tqdm's own lock is one of processes too, of which a process that is killed leaves a semaphore.
progress.set_lock(threading.RLock())
