"""The command ``giril``: its short subcommands, and the exit code of every one.

Exit codes: 0 done; 1 a bug, with its traceback; 2 a wrong input and 3 a run that could not go on
(a full disk, a loss that is not a number), in one sentence on standard error (``--traceback`` shows
where); 130 interrupted. Only the commands that need Torch, TorchRL and Hydra import them.
"""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path

from giril_rl.cli.parser import Parser, check_number
from giril_rl.config import recipes
from giril_rl.config.nearest import did_you_mean
from giril_rl.errors import FAILED, INTERRUPTED, RunError, UserError, told


def _ls(argv: Sequence[str]) -> int:
    """List the recipes."""
    Parser("giril ls", description=_ls.__doc__).parse_args(argv)
    found = recipes.shipped()
    width = max(len(recipe.name) for recipe in found)
    for recipe in found:
        print(f"{recipe.name:<{width}}  {recipe.docstring.partition(chr(10))[0]}")
    return 0


def _cp(argv: Sequence[str]) -> int:
    """Copy a recipe and its settings, to change them."""
    parser = Parser("giril cp", description=_cp.__doc__)
    parser.add_argument("recipe", metavar="RECIPE", help="a name that `giril ls` shows")
    parser.add_argument("file", metavar="FILE", type=Path, help="where to, such as my_recipe.py")
    args = parser.parse_args(argv)
    file, settings = recipes.copy(recipes.find(args.recipe), args.file)
    print(f"{file} and {settings} are yours: change them, then `giril run {file}`.")
    return 0


def _run(argv: Sequence[str]) -> int:
    """Run a recipe; key=value changes a knob."""
    from giril_rl.cli.run import run

    return run(argv, _run.__doc__, _refuse)


def _eval(argv: Sequence[str]) -> int:
    """Score a run's policy on fresh environments."""
    parser = Parser("giril eval", description=_eval.__doc__)
    parser.add_argument("run", metavar="RUN", type=Path, help="the folder of a run")
    parser.add_argument("--episodes", type=int, metavar="N", help="whole episodes to play")
    parser.add_argument("--seed", type=int, metavar="S", help="seed of the episodes")
    parser.add_imports()
    args = parser.parse_args(argv)
    if not args.run.is_dir():
        raise UserError(f"there is no run folder {args.run}.")
    check_number("--episodes", args.episodes, least=1)
    check_number("--seed", args.seed, least=0)
    from giril_rl.config.imports import import_modules

    import_modules(args.imports, Path.cwd())
    from giril_rl.training.rescore import evaluate_run

    evaluate_run(args.run, args.episodes, args.seed)
    return 0


def _demo(argv: Sequence[str]) -> int:
    """Show a demonstration, import, export or play one."""
    from giril_rl.cli.demo import demo

    return demo(argv, _demo.__doc__)


def _study(argv: Sequence[str]) -> int:
    """Make the runs of a study, several at a time."""
    from giril_rl.cli.study import study

    return study(argv, _study.__doc__, main)


def _report(argv: Sequence[str]) -> int:
    """Write tables and curves of all runs below a folder."""
    parser = Parser("giril report", description=_report.__doc__)
    parser.add_argument("runs", metavar="DIR", type=Path, help="the folder that the runs are in")
    parser.add_argument(
        "--out", type=Path, metavar="FOLDER", help="where to write; DIR/report if not given"
    )
    args = parser.parse_args(argv)
    if not args.runs.is_dir():
        raise UserError(f"there is no folder {args.runs}.")
    from giril_rl.experiments.report.report import write_report

    print(write_report(args.runs, args.out or args.runs / "report"))
    return 0


_COMMANDS: dict[str, tuple[Callable[[Sequence[str]], int], str]] = {
    "ls": (_ls, "giril ls"),
    "cp": (_cp, "giril cp RECIPE FILE"),
    "run": (_run, "giril run RECIPE [key=value ...] [-m] [--help]"),
    "eval": (_eval, "giril eval RUN [--episodes N] [--seed S] [--import MODULE]"),
    "demo": (_demo, "giril demo show|import|export|play ... [--help]"),
    "study": (_study, "giril study STUDY [key=value ...] [--dry-run]"),
    "report": (_report, "giril report DIR [--out FOLDER]"),
}


def _usage() -> str:
    width = max(len(usage) for _, usage in _COMMANDS.values())
    rows = [f"  {usage:<{width}}  {command.__doc__}" for command, usage in _COMMANDS.values()]
    last = "`giril COMMAND --help` says more; --traceback shows where a refusal came from."
    return "\n".join(["Imitation learning with generated rewards.", "", *rows, "", last])


def _refuse(error: Exception, show_traceback: bool = False) -> int:
    sentence = told(error)
    code = 2 if isinstance(sentence, UserError) else FAILED if isinstance(sentence, RunError) else 1
    if show_traceback or code == 1:
        traceback.print_exception(error)
    if code != 1:
        print(f"giril: {sentence}", file=sys.stderr)
    return code


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Args:
        argv: the words after ``giril``; None takes them from the process.

    Examples:
        >>> main(["ls"])
        airl ...
        0
    """
    words = list(sys.argv[1:] if argv is None else argv)
    show_traceback = "--traceback" in words
    words = [word for word in words if word != "--traceback"]
    try:
        if not words or words[0] in ("-h", "--help"):
            print(_usage())
            return 0
        if words[0] not in _COMMANDS:
            hint = did_you_mean(words[0], _COMMANDS) or f": choose one of {', '.join(_COMMANDS)}."
            raise UserError(f"{words[0]!r} is not a command{hint}")
        return _COMMANDS[words[0]][0](words[1:])
    except KeyboardInterrupt as interrupt:
        print(f"giril: {str(interrupt) or 'interrupted'}.", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # The reader, such as `head`, has seen enough; nothing may be flushed into its pipe again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except Exception as error:
        return _refuse(error, show_traceback)
