"""What a study's runs print, one file for each run."""

from __future__ import annotations

import os
from pathlib import Path

MOST_BYTES = 2**20
"""Of a log, before a run is started again: a study may be started any number of times."""
_TAIL = 2**16


def begin_log(log: Path, command: list[str]) -> None:
    r"""Adds to a log what is about to be run; one that is too long is put aside, ``NAME.log.old``.

    Args:
        log: the file; its folder is made if need be.
        command: the words after ``giril``.

    Examples:
        >>> import tempfile
        >>> log = Path(tempfile.mkdtemp()) / "a.log"
        >>> _ = log.write_text("x" * (MOST_BYTES + 1))
        >>> begin_log(log, ["run", "bc"])
        >>> log.read_text(), sorted(path.name for path in log.parent.iterdir())
        ('\n$ giril run bc\n', ['a.log', 'a.log.old'])
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    if log.is_file() and log.stat().st_size > MOST_BYTES:
        os.replace(log, log.with_name(f"{log.name}.old"))
    with open(log, "ab") as output:
        output.write(f"\n$ giril {' '.join(command)}\n".encode())


def last_line(log: Path) -> str:
    """The last line of a log that holds anything, empty where there is none."""
    try:
        with open(log, "rb") as file:
            file.seek(max(os.fstat(file.fileno()).st_size - _TAIL, 0))
            text = file.read().decode("utf-8", errors="replace")
    except OSError:
        return ""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else ""
