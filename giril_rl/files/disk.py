"""Writing files so that a kill at any moment leaves either the old content or the new."""

from __future__ import annotations

import contextlib
import csv
import glob
import io
import json
import os
import platform
import shutil
import sys
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from giril_rl.errors import UserError
from giril_rl.files.untrusted import parse_json, read_text

PACKAGES = ("torch", "torchrl", "tensordict", "gymnasium", "pybullet", "ale-py", "giril-rl")


def temporary_sibling(path: Path) -> Path:
    """The hidden name beside ``path`` under which this process prepares its next content.

    Examples:
        >>> temporary_sibling(Path("runs/a.json")).match("runs/.a.json.*.tmp")
        True
    """
    return path.with_name(f".{path.name}.{os.getpid()}.tmp")


def remove_leftovers(path: Path) -> None:
    """Remove what processes that were killed had prepared for ``path``, a file or a folder.

    Only for whoever alone may write it, such as the holder of a lock.

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


def missing(folder: Path) -> list[Path]:
    """Those of a folder and the folders above it that are yet to be made, innermost first.

    Examples:
        >>> import tempfile
        >>> top = Path(tempfile.mkdtemp())
        >>> [place.name for place in missing(top / "runs" / "a")]
        ['a', 'runs']
    """
    return [place for place in (folder, *folder.parents) if not place.exists()]


def remove_empty(folders: Iterable[Path]) -> None:
    """Remove folders up to the first one that holds something or cannot be removed.

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


def sync(path: Path) -> None:
    """Ask the disk to keep ``path``, a file or a folder, through a power cut."""
    if path.is_dir() and os.name == "nt":  # Windows cannot open a folder
        return
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_atomically(path: Path, content: bytes | str) -> None:
    """Write ``content`` to ``path`` at once: a reader, or a kill, never meets half a file.

    Args:
        path: the file; its folder is made if need be.
        content: bytes, or text that is written as UTF-8.

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


def name_file(error: BaseException, path: Path) -> None:
    """Let an error of the disk say which file it is about, which a failed write does not."""
    if isinstance(error, OSError) and error.errno is not None and error.filename is None:
        error.filename = str(path)


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
    """A header and rows as CSV; None is an empty cell, numbers are unrounded.

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


def processor() -> str:
    """The processor's name, as the system tells it.

    Examples:
        >>> bool(processor())
        True
    """
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine() or "unknown"


def installed_versions() -> dict[str, str | None]:
    """Versions of Python and of the packages that decide a run's numbers; None if not installed.

    Examples:
        >>> sorted(installed_versions())
        ['ale_py', 'giril_rl', 'gymnasium', 'pybullet', 'python', 'tensordict', 'torch', 'torchrl']
    """
    versions: dict[str, str | None] = {"python": ".".join(map(str, sys.version_info[:3]))}
    for name in PACKAGES:
        try:
            versions[name.replace("-", "_")] = version(name)
        except PackageNotFoundError:
            versions[name.replace("-", "_")] = None
    return versions
