"""Ctrl-C that lets a loop save before it stops."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType, TracebackType
from typing import Any


class Interrupted(KeyboardInterrupt):
    """A loop stopped because it was asked to, after having saved its state.

    Examples:
        >>> str(Interrupted.at(120_000, 300_000))
        'interrupted at 120,000 of 300,000 steps: the same command continues from there'
    """

    @classmethod
    def at(
        cls, done: int, total: int, unit: str = "steps", *, part: str = "", most: bool = False
    ) -> Interrupted:
        """The exception with the sentence that tells the user where the run stands.

        Args:
            done: how much is done and saved.
            total: how much there is to do.
            unit: what is counted.
            part: the part of the run that was interrupted, such as "the player's training".
            most: says that the part may end before ``total``.

        Examples:
            >>> str(Interrupted.at(2_000, 5_000_000, part="the player's training", most=True))
            "interrupted in the player's training at 2,000 of at most 5,000,000 steps: the same
            command continues from there"
        """
        where, bound = f" in {part}" if part else "", "at most " if most else ""
        return cls(
            f"interrupted{where} at {done:,} of {bound}{total:,} {unit}: the same command "
            "continues from there"
        )


class Interrupt:
    """Turns the first SIGINT or SIGTERM into a flag that a loop polls where it is safe to save.

    The second signal raises KeyboardInterrupt at once. Handlers are installed in the main thread
    only, and put back at the end; a signal that the process was started to ignore stays ignored.
    Inside another Interrupt, the outer one's flag is shared, so one Ctrl-C stops all loops.

    Examples:
        >>> with Interrupt() as interrupt:
        ...     for step in range(5):
        ...         if step == 2:
        ...             signal.raise_signal(signal.SIGTERM)
        ...         if interrupt.requested:
        ...             break
        >>> step
        2
    """

    _outer: Interrupt | None = None

    def __init__(self) -> None:
        self._requested = False
        self._shared: Interrupt | None = None
        self._previous: dict[signal.Signals, Any] = {}

    @property
    def requested(self) -> bool:
        """True once a signal has come."""
        return self._requested if self._shared is None else self._shared.requested

    def __enter__(self) -> Interrupt:
        self._requested = False
        if Interrupt._outer is not None:
            self._shared = Interrupt._outer
        elif threading.current_thread() is threading.main_thread():
            Interrupt._outer = self
            for number in (signal.SIGINT, signal.SIGTERM):
                previous = signal.getsignal(number)
                if previous not in (signal.SIG_IGN, None):
                    self._previous[number] = previous
                    signal.signal(number, self._handle)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._requested, self._shared = self.requested, None
        if Interrupt._outer is self:
            Interrupt._outer = None
            for number, previous in self._previous.items():
                signal.signal(number, previous)
            self._previous.clear()

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._requested:
            raise KeyboardInterrupt
        self._requested = True
        # Not sys.stderr: its buffer may be in the middle of a write.
        os.write(2, b"\nstopping after this step; once more to stop at once without saving\n")


def gentle_signal() -> signal.Signals:
    """What asks a run of this process, or one below it, to save its state and stop.

    A process that was started in the background ignores SIGINT, and so do its children.
    """
    ignored = signal.getsignal(signal.SIGINT) in (signal.SIG_IGN, None)
    return signal.SIGTERM if ignored else signal.SIGINT
