"""The two exceptions that a user is meant to read, and how a command ends that did not finish."""

from __future__ import annotations

import errno

FAILED = 3
"""The exit code of a run that could not go on, such as for want of disk space."""
INTERRUPTED = 130
"""The exit code after Ctrl-C."""

_ROOM = "make room there, then give the same command again"
_ELSEWHERE = "make it writable, or choose another place with out= and root="
_REMEDY = {
    errno.ENOSPC: _ROOM,
    errno.EDQUOT: _ROOM,
    errno.EFBIG: "raise the limit on the size of files, then give the same command again",
    errno.EROFS: _ELSEWHERE,
    errno.EACCES: _ELSEWHERE,
    errno.EPERM: _ELSEWHERE,
    errno.ENOTDIR: "choose another place with out= and root=",
    errno.EIO: "look after the disk, then give the same command again",
}


class UserError(Exception):
    """Bad input, named in one sentence that says what was wrong and what to do.

    The command line prints the sentence without a traceback and exits with status 2.

    Examples:
        >>> raise UserError("reward.beta=0 is outside (0, 1]: give a value such as 1.0.")
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: reward.beta=0 is outside (0, 1]: give a value such as 1.0.
    """


def first_line(error: Exception) -> str:
    r"""The first line of an error's message, without a full stop.

    Examples:
        >>> first_line(ValueError("out of order.\nSee the manual."))
        'out of order'
    """
    return (str(error).strip().splitlines() or [type(error).__name__])[0].rstrip(".")


class RunError(Exception):
    """Why a run could not go on, in one sentence that says what happened and what to do.

    What was saved before is as it was. The command line prints the sentence without a traceback and
    exits with status :data:`FAILED`.

    Examples:
        >>> raise RunError("ppo/loss_critic is nan: give a smaller step size.")
        Traceback (most recent call last):
        ...
        giril_rl.errors.RunError: ppo/loss_critic is nan: give a smaller step size.
    """


def told(error: Exception) -> Exception:
    """A :class:`RunError` that tells of an error of the disk; any other error as it is.

    Examples:
        >>> full = OSError(errno.ENOSPC, "No space left on device", "runs/a/ppo.safetensors")
        >>> print(told(full))
        runs/a/ppo.safetensors cannot be used (No space left on device): make room there, then give
        the same command again; what was saved before is as it was.
        >>> told(KeyError("x"))
        KeyError('x')
    """
    if not isinstance(error, OSError) or error.errno not in _REMEDY:
        return error
    where = error.filename2 or error.filename or "a file"
    return RunError(
        f"{where} cannot be used ({error.strerror}): {_REMEDY[error.errno]}; what was saved before "
        "is as it was."
    )
