"""Whether a folder can be made and written to, looked at before any work is done."""

from __future__ import annotations

import os
from pathlib import Path

from giril_rl.errors import UserError


def check_place(folder: Path, key: str) -> None:
    """Refuses a folder that could not be made or written to; nothing is made.

    Args:
        folder: what is to be made, or is there already.
        key: how the user chose it, such as ``"out="``.

    Raises:
        UserError: in one sentence.

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
            if there == there.parent:  # Such as a drive that is not there.
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
    except (OSError, ValueError) as error:  # Such as a name that is too long.
        raise cannot_write(folder, key, error) from None


def cannot_write(folder: Path, key: str, error: Exception) -> UserError:
    """The refusal of a folder that the system would not have."""
    reason = getattr(error, "strerror", None) or error
    shown = str(folder)
    shown = shown if len(shown) <= 200 else f"{shown[:200]}..."
    return UserError(f"{shown!r} cannot be written ({reason}): choose another {key}.")
