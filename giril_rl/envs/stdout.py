"""Simulators that print, made silent."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator


@contextlib.contextmanager
def silent_stdout(*, stderr: bool = False) -> Iterator[None]:
    """Drops what C code prints on standard output, as pybullet does whenever it connects.

    Args:
        stderr: drop what is printed on standard error as well, as pybullet does when imported.
    """
    streams = [sys.stdout, sys.stderr] if stderr else [sys.stdout]
    for stream in streams:
        stream.flush()
    saved = [os.dup(descriptor) for descriptor in range(1, len(streams) + 1)]
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        for descriptor in range(1, len(streams) + 1):
            os.dup2(null, descriptor)
        yield
    finally:
        for descriptor, (stream, kept) in enumerate(zip(streams, saved, strict=True), 1):
            stream.flush()
            os.dup2(kept, descriptor)
            os.close(kept)
        os.close(null)
