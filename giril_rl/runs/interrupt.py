"""Ctrl-C: a loop saves its state before it stops."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType
from typing import Any


class Interrupted(KeyboardInterrupt):
    """A loop was asked to stop, and has saved its state."""

    @classmethod
    def at(
        cls, done: int, total: int, unit: str = "steps", *, part: str = "", most: bool = False
    ) -> Interrupted:
        """The exception, with a message that says how far the run is.

        Args:
            done: steps done and saved.
            total: steps of the whole part.
            unit: what a step is called.
            part: the part of the run, such as "the player's training".
            most: whether the part may end before ``total``.

        Examples:
            >>> str(Interrupted.at(120_000, 300_000))
            'interrupted at 120,000 of 300,000 steps: the same command continues from there'
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
    """Turns the first SIGINT or SIGTERM into a flag, which a loop polls where it can save.

    The second signal raises KeyboardInterrupt at once. Handlers are installed in the main thread
    only, and restored at the end. A signal that the process ignores stays ignored. Nested ones
    share the flag of the outermost, so that one Ctrl-C stops all loops.

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
        """Whether a signal has arrived."""
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

    def __exit__(self, *raised: object) -> None:
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
        # Not sys.stderr: the signal may have interrupted a write to its buffer.
        os.write(2, b"\nstopping after this step; once more to stop at once without saving\n")


def gentle_signal() -> signal.Signals:
    """The signal that asks a run in this process, or in a child of it, to save and stop.

    A shell starts background processes with SIGINT ignored, and children inherit that.
    """
    ignored = signal.getsignal(signal.SIGINT) in (signal.SIG_IGN, None)
    return signal.SIGTERM if ignored else signal.SIGINT
