"""A progress bar for a terminal, and now and then a line for a log."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import Any, TextIO

from tqdm import tqdm


class progress:
    """Steps done, steps per second and time left, on the standard error stream.

    A terminal gets a bar. Anything else, such as a file or a batch system's log, gets one whole
    line at most every ``interval`` seconds, and nothing at all for work shorter than that.

    Args:
        total: steps of the whole work, including those of an earlier process.
        initial: steps done before this process began; they count for the bar, not for the speed.
        desc: the work's name.
        unit: what a step is called.
        interval: seconds between lines without a terminal.
        stream: where to write; None takes ``sys.stderr``.
        disable: write nothing and only count.

    Examples:
        >>> import io
        >>> log = io.StringIO()
        >>> with progress(400, 100, "policy", interval=0.0, stream=log) as bar:
        ...     bar.update(300, loss=0.25)
        >>> print(log.getvalue())  # doctest: +ELLIPSIS
        policy: 100%|...| 400/400 [...steps/s, loss=0.25]...
    """

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
        self.total, self.initial, self.done = total, initial, initial
        self.desc, self.unit, self.interval = desc, f" {unit}", interval
        self.stream = sys.stderr if stream is None else stream
        self._postfix: dict[str, Any] = {}
        self._began = self._written = time.monotonic()
        self._last_done = initial
        self._lines = 0
        self._disable = disable
        self._bar: tqdm | None = None
        if self.stream.isatty() and not disable:
            self._bar = tqdm(
                total=total,
                initial=initial,
                desc=desc,
                unit=self.unit,
                file=self.stream,
                dynamic_ncols=True,
            )

    def update(self, steps: int = 1, **values: float | str) -> None:
        """Count ``steps`` more and show ``values`` (such as a loss) behind the speed."""
        self.done += steps
        self._postfix.update(values)
        if self._bar is not None:
            if values:
                self._bar.set_postfix(self._postfix, refresh=False)
            self._bar.update(steps)
        elif not self._disable and time.monotonic() - self._written >= self.interval:
            self._write_line()

    def close(self) -> None:
        """End the bar, or write the last line if there was any before."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None
        elif self._lines and self._last_done != self.done:
            self._write_line()

    def _write_line(self) -> None:
        now = time.monotonic()
        line = tqdm.format_meter(
            self.done,
            self.total,
            now - self._began,
            ncols=100,
            prefix=self.desc,
            ascii=True,
            unit=self.unit,
            postfix=", ".join(f"{key}={value}" for key, value in self._postfix.items()) or None,
            initial=self.initial,
        )
        self.stream.write(f"{line}\n")
        self.stream.flush()
        self._written, self._last_done = now, self.done
        self._lines += 1

    def __enter__(self) -> progress:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
