"""Atomic writes: a kill at any moment leaves the old file or the new one, never half of one."""

from __future__ import annotations

import contextlib
import csv
import glob
import io
import json
import os
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from giril_rl.errors import UserError
from giril_rl.files.untrusted import parse_json, read_text


def write_atomically(path: Path, content: bytes | str) -> None:
    """Write ``content`` to a temporary file, sync it and rename it to ``path``.

    Args:
        path: the file; missing folders are made.
        content: bytes, or text to be encoded as UTF-8.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "note.txt"
        >>> write_atomically(path, "kept")
        >>> path.read_text(), [file.name for file in path.parent.iterdir()]
        ('kept', ['note.txt'])
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    data = content.encode() if isinstance(content, str) else content
    temporary = temporary_sibling(path)
    try:
        with open(temporary, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException as error:
        name_file(error, path)
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise
    sync(path.parent)


def sync(path: Path) -> None:
    """Flush a file or folder to the disk, so that it survives a power cut."""
    if path.is_dir() and os.name == "nt":  # Windows cannot open a folder.
        return
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def name_file(error: BaseException, path: Path) -> None:
    """Attach the file path to an OSError; a failed write has none."""
    if isinstance(error, OSError) and error.errno is not None and error.filename is None:
        error.filename = str(path)


def temporary_sibling(path: Path) -> Path:
    """The hidden file beside ``path`` in which this process prepares new content.

    Examples:
        >>> temporary_sibling(Path("runs/a.json")).match("runs/.a.json.*.tmp")
        True
    """
    return path.with_name(f".{path.name}.{os.getpid()}.tmp")


def remove_leftovers(path: Path) -> None:
    """Remove the temporary files or folders that killed processes left for ``path``.

    Call it only while no other process can write ``path``, for example while you hold a lock.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "note.txt"
        >>> temporary_sibling(path).touch()
        >>> remove_leftovers(path)
        >>> list(path.parent.iterdir())
        []
    """
    for leftover in path.parent.glob(f".{glob.escape(path.name)}.*.tmp"):
        if leftover.is_dir():
            shutil.rmtree(leftover)
        else:
            leftover.unlink()


def write_json(path: Path, value: Any) -> None:
    """Write ``value`` as indented JSON, atomically.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "result.json"
        >>> write_json(path, {"return_mean": 990.2})
        >>> read_json(path)
        {'return_mean': 990.2}
    """
    write_atomically(path, json.dumps(value, indent=2) + "\n")


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in ``path``.

    Raises:
        UserError: if the file cannot be read or does not hold a JSON object.
    """
    try:
        value = parse_json(read_text(path))
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read as JSON ({error}): delete or restore it.") from None
    if not isinstance(value, dict):
        raise UserError(f"{path} does not hold a JSON object: delete or restore it.")
    return value


def csv_text(columns: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    """A header and rows as CSV; None becomes an empty cell, numbers are not rounded.

    Examples:
        >>> print(csv_text(["step", "loss"], [(100, None), (200, 0.25)]), end="")
        step,loss
        100,
        200,0.25
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return text.getvalue()


def missing(folder: Path) -> list[Path]:
    """The folders that ``folder.mkdir(parents=True)`` would make, innermost first.

    Examples:
        >>> import tempfile
        >>> top = Path(tempfile.mkdtemp())
        >>> [place.name for place in missing(top / "runs" / "a")]
        ['a', 'runs']
    """
    return [place for place in (folder, *folder.parents) if not place.exists()]


def remove_empty(folders: Iterable[Path]) -> None:
    """Remove folders in turn; stop at the first that is not empty or cannot be removed.

    Examples:
        >>> import tempfile
        >>> top = Path(tempfile.mkdtemp())
        >>> made = missing(top / "runs" / "a")
        >>> made[0].mkdir(parents=True)
        >>> remove_empty([*made, top.parent])
        >>> top.exists(), list(top.iterdir())
        (True, [])
    """
    with contextlib.suppress(OSError):
        for folder in folders:
            folder.rmdir()


def check_place(folder: Path, key: str) -> None:
    """Refuse a folder that cannot be made or written to, before any work is done.

    Args:
        folder: the folder, which may exist; nothing is made.
        key: the user's setting, such as ``"out="``.

    Raises:
        UserError: if a file is in the way, or the folder is not writable.

    Examples:
        >>> check_place(Path("runs/giril"), "out=")
        >>> check_place(Path(os.devnull) / "run", "out=")
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: .../run cannot be made, for ... is a file: choose another out=.
    """
    try:
        there = folder
        while not (there.exists() or there.is_symlink()):
            if there == there.parent:  # For example a Windows drive that does not exist.
                raise FileNotFoundError(f"there is no {there}")
            there = there.parent
        if there == folder and not there.is_dir():
            raise UserError(f"{folder} is a file: choose another {key}.")
        if not there.is_dir():
            raise UserError(
                f"{folder} cannot be made, for {there} is a file: choose another {key}."
            )
        if not os.access(there, os.W_OK | os.X_OK):
            raise UserError(f"{folder} cannot be written: choose another {key}.")
    except (OSError, ValueError) as error:  # For example a name that is too long.
        raise cannot_write(folder, key, error) from None


def cannot_write(folder: Path, key: str, error: Exception) -> UserError:
    """The refusal of a folder in which the system did not let us write."""
    reason = getattr(error, "strerror", None) or error
    shown = str(folder)
    shown = shown if len(shown) <= 200 else f"{shown[:200]}..."
    return UserError(f"{shown!r} cannot be written ({reason}): choose another {key}.")
