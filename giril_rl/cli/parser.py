"""The argument parser of every subcommand."""

from __future__ import annotations

import argparse
from typing import NoReturn

from giril_rl.config.knobs import MOST
from giril_rl.errors import UserError


class Parser(argparse.ArgumentParser):
    """Refuses wrong arguments in one sentence, as the whole command line does.

    Examples:
        >>> Parser("giril ls").parse_args(["--all"])
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: unrecognized arguments: --all; see `giril ls --help`.
    """

    def error(self, message: str) -> NoReturn:
        """Raises argparse's message."""
        raise UserError(f"{message}; see `{self.prog} --help`.")

    def add_imports(self) -> None:
        """Adds ``--import MODULE``, which may be given several times."""
        self.add_argument(
            "--import",
            dest="imports",
            action="append",
            default=[],
            metavar="MODULE",
            help="a module of yours that registers the environment, found here too",
        )


def check_number(option: str, number: int | None, *, least: int) -> None:
    """Refuses an integer that is too small, or larger than files can keep.

    Examples:
        >>> check_number("--seed", 2**63, least=0)
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: --seed 9223372036854775808: at most 9223372036854775807 is
        possible.
    """
    if number is not None and number < least:
        raise UserError(f"{option} {number}: at least {least} is needed.")
    if number is not None and number > MOST:
        raise UserError(f"{option} {number}: at most {MOST} is possible.")
