"""Versions of the formats that files are written in, and the refusal of others."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

from giril_rl.errors import UserError
from giril_rl.files.disk import read_json

RUN_FORMAT = 2
"""Of a run's folder. Folders without a number are from before it was written down, and are 1.

Format 1 had the same files, made with other random numbers: it can be read, not continued.
"""


def check_format(found: Any, readable: Collection[int], *, where: str, older: str) -> None:
    """Refuses a format that this version cannot read, and says what to do.

    Args:
        found: the number in the file, of any type: anyone may have written it.
        readable: the numbers that can be read.
        where: the file and the kind of format, such as ``"a.json has card format"``.
        older: what to do about an older file, or one without a number.

    Raises:
        UserError: in one sentence.

    Examples:
        >>> check_format(1, [1], where="card.json has format", older="save it again")
        >>> check_format(9, [1], where="card.json has format", older="save it again")
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: card.json has format 9, written by a later giril_rl (this one
        reads up to 1): upgrade giril_rl.
    """
    if type(found) is int and found in readable:
        return
    newest = max(readable)
    if type(found) is int and found > newest:
        raise UserError(
            f"{where} {found}, written by a later giril_rl (this one reads up to {newest}): "
            "upgrade giril_rl."
        )
    known = " and ".join(map(str, sorted(readable)))
    raise UserError(f"{where} {found!r}, and this giril_rl reads only {known}: {older}.")


def check_run_format(folder: Path, readable: Collection[int] = (1, RUN_FORMAT)) -> None:
    """Refuses a run's folder of another format, by its ``versions.json``.

    Args:
        folder: the run's folder.
        readable: the formats that will do.

    Raises:
        UserError: in one sentence.
    """
    path = folder / "versions.json"
    if path.is_file():
        check_format(
            read_json(path).get("format_version", 1),
            readable,
            where=f"{folder} has run format",
            older="use the version that made it, or make the run anew",
        )
