"""The subcommand ``giril demo``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from giril_rl.cli_parser import Parser
from giril_rl.errors import UserError

FASTEST = 50
"""Frames a second: a GIF counts in hundredths of a second, and viewers slow down a single one."""


def demo(argv: Sequence[str], description: str | None = None) -> int:
    """Prints what a demonstration holds, and writes its frames where ``--out`` says so.

    Args:
        argv: the words after ``giril demo``.
        description: of the command, for its help.

    Raises:
        UserError: if there is no such demonstration, or it has no frames to write.
    """
    parser = Parser("giril demo", description=description)
    parser.add_argument("what", choices=("show",), metavar="show", help="print what it holds")
    parser.add_argument("path", metavar="PATH", type=Path, help="the folder of a demonstration")
    parser.add_argument(
        "--out", type=Path, metavar="FILE.gif", help="write the frames of images, enlarged"
    )
    parser.add_argument(
        "--fps", type=int, default=15, metavar="N", help="frames per second; 15 is a game's own"
    )
    args = parser.parse_args(argv)
    _check(args.path, args.out, args.fps)
    from giril_rl.demos import Demonstration
    from giril_rl.demos.show import describe

    found = Demonstration.load(args.path)
    if args.out is not None:
        from giril_rl.demos.gif import write_gif

        write_gif(found, args.out, args.fps)
    print(describe(found))
    return 0


def _check(path: Path, out: Path | None, fps: int) -> None:
    if not (path / "card.json").is_file():
        raise UserError(
            f"{path} is not the folder of a demonstration: recipes keep theirs in "
            "runs/demos/TASK/HASH."
        )
    if not 1 <= fps <= FASTEST:
        raise UserError(f"--fps {fps}: from 1 to {FASTEST} is possible.")
    if out is None:
        return
    if out.suffix.lower() != ".gif":
        raise UserError(f"--out {out} does not end in .gif: frames are written as a GIF.")
    if not out.parent.is_dir():
        raise UserError(f"{out} cannot be written: there is no folder {out.parent}.")
