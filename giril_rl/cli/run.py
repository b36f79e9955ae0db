"""``giril run``: make a run, or every run of a sweep, and show a recipe's knobs."""

from __future__ import annotations

import shutil
import sys
import textwrap
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from giril_rl.cli.parser import Parser
from giril_rl.config.recipes import Recipe, config_class, find
from giril_rl.errors import UserError
from giril_rl.files.disk import check_place


def run(argv: Sequence[str], description: str | None, refuse: Callable[[Exception], int]) -> int:
    """Makes the runs that the words after ``giril run`` ask for.

    Args:
        argv: the words.
        description: of the command, for its help.
        refuse: prints why a job of a sweep failed and returns its exit code.

    Raises:
        UserError: before any run is started, for whatever is wrong with any job.
    """
    parser = Parser("giril run", description=description, add_help=False)
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
    # A recipe that was copied from an earlier version may use names that are about to go.
    warnings.filterwarnings("default", r"giril_rl\.", DeprecationWarning)
    recipe, texts = find(args.words[0]), args.words[1:]
    schema = config_class(recipe)
    if args.help:
        print(recipe_help(recipe, schema, texts))
        return 0

    from giril_rl.config.overrides import sweep
    from giril_rl.runs.machine import keep_freed_memory

    jobs = _jobs(recipe, schema, sweep(texts) if args.multirun else [texts])
    keep_freed_memory()
    module = recipe.load()
    if not args.multirun:
        ((out, words),) = jobs.items()
        _make(recipe, module, out, words)
        return 0
    failed: dict[str, int] = {}
    for number, (out, words) in enumerate(jobs.items(), 1):
        title = " ".join([recipe.word, *words])
        print(f"[{number}/{len(jobs)}] {title}", flush=True)
        try:
            _make(recipe, module, out, words)
        except Exception as error:
            failed[title] = refuse(error)
    if failed:
        print(f"giril: {len(failed)} of {len(jobs)} jobs failed:", file=sys.stderr)
        for title in failed:
            print(f"  {title}", file=sys.stderr)
    return min(failed.values(), default=0)


def _jobs(
    recipe: Recipe, schema: type[Any], sweep: Sequence[Sequence[str]]
) -> dict[Path, Sequence[str]]:
    """Each job's folder and words, all of them checked, with the modules they name imported."""
    from giril_rl.config.compose import Composer
    from giril_rl.config.imports import import_modules, modules_of
    from giril_rl.runs.identity import check_sources, out_folder, sources

    composer = Composer(recipe, schema)
    jobs: dict[Path, Sequence[str]] = {}
    modules: dict[Path, list[str]] = {}
    for words in sweep:
        job = composer.job(words)
        out = out_folder(recipe.name, job.config, job.changes)
        if out in jobs:
            raise UserError(
                f"two jobs are the same run, {out}: leave one of them out."
                if job.config.out is None
                else f"two jobs would share the folder {out}: leave out= to giril, or vary it."
            )
        check_place(out, "out=")
        demo = getattr(job.config, "demo", None)
        if job.config.out is None or (demo is not None and demo.path is None):
            check_place(Path(job.config.root), "root=")
        jobs[out], modules[out] = words, modules_of(job.config)
    for out, names in modules.items():
        import_modules(names, *recipe.folders)
        check_sources(out, sources(recipe, names))
    return jobs


def _make(recipe: Recipe, module: Any, out: Path, words: Sequence[str]) -> None:
    from giril_rl.config.compose import resolved
    from giril_rl.config.imports import modules_of
    from giril_rl.config.validation import notices
    from giril_rl.runs.identity import is_scored_as, making, sources

    config, _ = resolved(recipe, module.Config, words)
    for sentence in notices(config):
        print(f"giril: {sentence}", file=sys.stderr)
    if "torch" in sys.modules:  # Every recipe that trains something imports it.
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


def recipe_help(recipe: Recipe, schema: type[Any], texts: Sequence[str] = ()) -> str:
    """A recipe's page: its docstring, its config groups, and every knob with default and help.

    Args:
        recipe: the recipe.
        schema: its ``Config`` class.
        texts: overrides whose effect on the defaults is shown.
    """
    from giril_rl.config.compose import groups
    from giril_rl.config.knobs import knobs

    width = min(shutil.get_terminal_size((100, 24)).columns, 120)
    page = [f"giril run {recipe.word} [key=value ...] [-m]", "", recipe.docstring, "", "Choices"]
    for name, (choices, default) in groups(recipe).items():
        marked = [f"{choice} (default)" if choice == default else choice for choice in choices]
        page += _row([name], [8], ", ".join(marked), width)
    page += _row([""], [8], "task.env_id=ID alone chooses the task gymnasium or atari", width)

    defaults = _defaults(recipe, schema, texts)
    widths = [max(map(len, defaults)), min(max(map(len, defaults.values())), 12)]
    # A recipe's own knobs come first, then its parts in order.
    by_part: dict[str, list[str]] = {"": []}
    for knob in knobs(schema):
        part = knob.key.rpartition(".")[0].partition(".")[0]
        row = _row([knob.key, defaults[knob.key]], widths, knob.line, width)
        by_part.setdefault(part, []).extend(row)
    for part, rows in by_part.items():
        page += ["", part or "Knobs (key, default, meaning)", *rows]
    page += ["", "Several values, such as seed=0,1,2, run one after another with -m."]
    return "\n".join(page)


def _defaults(recipe: Recipe, schema: type[Any], texts: Sequence[str]) -> Mapping[str, str]:
    """The value of every knob as text; mandatory ones may be missing."""
    from omegaconf import OmegaConf
    from omegaconf.errors import InterpolationToMissingValueError

    from giril_rl.config.compose import compose
    from giril_rl.config.knobs import default_text, knobs
    from giril_rl.config.tasks import task_defaults

    composed = compose(recipe, schema, texts)
    missing = OmegaConf.is_missing(composed.node.task, "env_id")
    kind = {} if missing else task_defaults(composed.node.task.env_id, composed.chosen)
    found = {}
    for knob in knobs(schema):
        part, _, name = knob.key.rpartition(".")
        parent = OmegaConf.select(composed.node, part) if part else composed.node
        try:
            value = "???" if OmegaConf.is_missing(parent, name) else parent[name]
        except InterpolationToMissingValueError:
            value = "???"
        found[knob.key] = default_text(kind.get(knob.key, value))
    return found


def _row(columns: Sequence[str], widths: Sequence[int], text: str, width: int) -> list[str]:
    cells = [f"{cell:<{size}}" for cell, size in zip(columns, widths, strict=True)]
    head = "  ".join(["", *cells, ""])
    room = max(width - len(head), 30)
    first, *rest = textwrap.wrap(text, room) or [""]
    return [(head + first).rstrip(), *(" " * len(head) + line for line in rest)]
