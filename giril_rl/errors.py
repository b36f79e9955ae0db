"""The one exception that a user is meant to read, and how a command ends that was interrupted."""

INTERRUPTED = 130
"""The exit code after Ctrl-C."""


class UserError(Exception):
    """Bad input, named in one sentence that says what was wrong and what to do.

    The command line prints the sentence without a traceback and exits with status 2.

    Examples:
        >>> raise UserError("reward.beta=0 is outside (0, 1]: give a value such as 1.0.")
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: reward.beta=0 is outside (0, 1]: give a value such as 1.0.
    """
