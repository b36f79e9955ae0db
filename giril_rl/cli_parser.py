"""The parser of every subcommand."""

from __future__ import annotations

import argparse
from typing import NoReturn

from giril_rl.errors import UserError


class Parser(argparse.ArgumentParser):
    """Refuses in one sentence, as everything of the command line does.

    Examples:
        >>> Parser("giril ls").parse_args(["--all"])
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: unrecognized arguments: --all; see `giril ls --help`.
    """

    def error(self, message: str) -> NoReturn:
        """Raises what argparse has to say."""
        raise UserError(f"{message}; see `{self.prog} --help`.")
