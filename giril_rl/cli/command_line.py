"""The command ``giril``: see the recipes, copy one, run one, evaluate a run.

Exit codes: 0 done; 1 an error that is not the user's, with its traceback; 2 refused and 3 a run
that could not go on (a full disk, a loss that is not a number), in one sentence on standard error
(``--traceback`` shows where); 130 interrupted. Torch, TorchRL and Hydra
are imported only by the commands that need them.
"""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from giril_rl.cli.parser import Parser as _Parser
from giril_rl.cli.parser import check_number
from giril_rl.config import recipe_files as recipes
from giril_rl.config.nearest import did_you_mean
from giril_rl.errors import FAILED, INTERRUPTED, RunError, UserError, told
from giril_rl.files.disk import check_place
from giril_rl.runs.machine import keep_freed_memory


def _ls(argv: Sequence[str]) -> int:
    """List the recipes."""
    _Parser("giril ls", description=_ls.__doc__).parse_args(argv)
    found = recipes.shipped()
    width = max(len(recipe.name) for recipe in found)
    for recipe in found:
        print(f"{recipe.name:<{width}}  {recipe.docstring.partition(chr(10))[0]}")
    return 0


def _cp(argv: Sequence[str]) -> int:
    """Copy a recipe and its settings, to change them."""
    parser = _Parser("giril cp", description=_cp.__doc__)
    parser.add_argument("recipe", metavar="RECIPE", help="a name that `giril ls` shows")
    parser.add_argument("file", metavar="FILE", type=Path, help="where to, such as my_recipe.py")
    args = parser.parse_args(argv)
    file, settings = recipes.copy(recipes.find(args.recipe), args.file)
    print(f"{file} and {settings} are yours: change them, then `giril run {file}`.")
    return 0


def _run(argv: Sequence[str]) -> int:
    """Run a recipe; key=value changes a knob."""
    parser = _Parser("giril run", description=_run.__doc__, add_help=False)
    parser.add_argument(
        "words",
        nargs="*",
        metavar="RECIPE [key=value ...]",
        help="a name that `giril ls` shows or a copied file, then any of its knobs",
    )
    parser.add_argument(
        "-m",
        "--multirun",
        action="store_true",
        help="run every combination of values like seed=0,1",
    )
    parser.add_argument("-h", "--help", action="store_true", help="show the recipe's knobs")
    args = parser.parse_intermixed_args(argv)
    if not args.words:
        if args.help:
            parser.print_help()
            return 0
        raise UserError("name a recipe: `giril ls` shows them.")
    recipe, texts = recipes.find(args.words[0]), args.words[1:]
    from giril_rl.config.recipe_config import config_class

    schema = config_class(recipe)
    if args.help:
        from giril_rl.cli.help import recipe_help

        print(recipe_help(recipe, schema, texts))
        return 0

    from giril_rl.config.compose import resolved
    from giril_rl.config.imports import import_modules, modules_of
    from giril_rl.config.jobs import Job, Jobs
    from giril_rl.config.overrides import sweep
    from giril_rl.config.validation import notices
    from giril_rl.runs.identity import check_sources, is_scored_as, making, out_folder, sources

    composing = Jobs()
    jobs: dict[Path, tuple[Job, list[str]]] = {}
    # All jobs are composed and checked first: a bad value in the last one stops the sweep at once.
    for words in sweep(texts) if args.multirun else [texts]:
        job = composing.job(recipe, schema, words)
        out = out_folder(recipe.name, job.config, job.changes)
        if out in jobs:
            raise UserError(
                f"two jobs are the same run, {out}: leave one of them out."
                if job.config.out is None
                else f"two jobs would share the folder {out}: leave out= to giril, or vary it."
            )
        check_place(out, "out=")
        if _makes_things_below_root(job.config):
            check_place(Path(job.config.root), "root=")
        jobs[out] = job, words
    for out, (job, _) in jobs.items():
        import_modules(modules_of(job.config), *recipe.folders)
        check_sources(out, sources(recipe, modules_of(job.config)))
    keep_freed_memory()
    module = recipe.load()

    def run(out: Path) -> None:
        config, _ = resolved(recipe, module.Config, jobs[out][1])
        for sentence in notices(config):
            print(f"giril: {sentence}", file=sys.stderr)
        if "torch" in sys.modules:  # As with every recipe that trains something.
            sys.modules["torch"].set_num_threads(config.threads)
        finished = (out / "result.json").exists()
        with making(out, sources(recipe, modules_of(config))):
            module.main(config, out)
        if finished and is_scored_as(out, config.eval):
            print(f"giril: {out} was finished earlier: nothing was run.", file=sys.stderr)
        elif finished:
            from giril_rl.training.rescore import score_anew

            score_anew(out, config.eval)
        if (out / "result.json").exists():
            from giril_rl.runs.finished import print_scores

            print_scores(out)

    if args.multirun:
        titles = {out: " ".join([recipe.word, *words]) for out, (_, words) in jobs.items()}
        return _run_all(run, titles)
    for out in jobs:
        run(out)
    return 0


def _makes_things_below_root(config: Any) -> bool:
    """The run itself, or an expert and a demonstration that were not given."""
    demo = getattr(config, "demo", None)
    return config.out is None or (demo is not None and demo.path is None)


def _run_all(run: Callable[[Path], None], titles: Mapping[Path, str]) -> int:
    failed: dict[str, int] = {}
    for number, (out, title) in enumerate(titles.items(), 1):
        print(f"[{number}/{len(titles)}] {title}", flush=True)
        try:
            run(out)
        except Exception as error:
            failed[title] = _refuse(error, show_traceback=False)
    if failed:
        print(f"giril: {len(failed)} of {len(titles)} jobs failed:", file=sys.stderr)
        for title in failed:
            print(f"  {title}", file=sys.stderr)
    return min(failed.values(), default=0)


def _eval(argv: Sequence[str]) -> int:
    """Score a run's policy on fresh environments."""
    parser = _Parser("giril eval", description=_eval.__doc__)
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
    parser = _Parser("giril study", description=_study.__doc__, add_help=False)
    parser.add_argument("words", nargs="*", metavar="STUDY [key=value ...]")
    parser.add_argument("--dry-run", action="store_true", help="only check and list the runs")
    parser.add_argument("-h", "--help", action="store_true")
    args = parser.parse_intermixed_args(argv)
    if args.help:
        from giril_rl.cli.study_help import study_help

        print(study_help())
        return 0
    if not args.words:
        raise UserError("name a study: `giril study --help` shows them.")
    from giril_rl.cli.study import run_study

    return run_study(args.words[0], args.words[1:], main, dry_run=args.dry_run)


def _report(argv: Sequence[str]) -> int:
    """Write tables and curves of all runs below a folder."""
    parser = _Parser("giril report", description=_report.__doc__)
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


def _refuse(error: Exception, show_traceback: bool) -> int:
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
        bc ...
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
