"""``giril demo``: show, import, export or play a demonstration."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from giril_rl.cli.parser import Parser, check_number
from giril_rl.errors import UserError

FASTEST = 50
"""Frames per second: a GIF counts in hundredths of a second, and viewers slow down a single one."""


def demo(argv: Sequence[str], description: str | None = None) -> int:
    """Does what the words after ``giril demo`` ask for.

    Args:
        argv: the words.
        description: of the command, for its help.

    Raises:
        UserError: for a demonstration or data set that is missing or damaged; then nothing is
            written.
    """
    parser = Parser("giril demo", description=description)
    kinds = parser.add_subparsers(metavar="show|import|export|play", required=True)
    for make in (_show, _import, _export, _play):
        make(kinds)
    args = parser.parse_args(argv)
    try:
        args.run(args)
    except BrokenPipeError:
        raise
    except OSError as error:
        raise UserError(
            f"{error.filename or 'a file'} could not be read or written ({error.strerror or error})"
            ": make room or choose another place."
        ) from error
    return 0


def _add(kinds: Any, name: str, run: Any) -> Parser:
    parser: Parser = kinds.add_parser(name, help=run.__doc__, description=run.__doc__)
    parser.set_defaults(run=run)
    return parser


def _add_task(parser: Parser) -> None:
    parser.add_argument("--task", metavar="TASK", help="a task's name, as in task=breakout")
    parser.add_argument(
        "--env-id", metavar="ID", help="or a Gymnasium id, as in Pendulum-v1 or my_envs:Ball-v0"
    )
    parser.add_imports()


def _import_modules(args: Namespace) -> None:
    """Imports the modules that the command line names, not those of a demonstration's card."""
    from giril_rl.config.imports import import_modules, named_modules

    import_modules([*args.imports, *named_modules(args.env_id)], Path.cwd())


def _show(kinds: Any) -> None:
    parser = _add(kinds, "show", _run_show)
    parser.add_argument(
        "path", metavar="PATH", type=Path, help="the folder of a demonstration, or shipped:TASK"
    )
    parser.add_argument(
        "--out", type=Path, metavar="FILE.gif", help="write the frames of images, enlarged"
    )
    parser.add_argument(
        "--fps", type=int, default=15, metavar="N", help="frames per second; 15 is a game's own"
    )


def _import(kinds: Any) -> None:
    parser = _add(kinds, "import", _run_import)
    parser.add_argument(
        "source",
        metavar="SOURCE",
        help="minari:NAME, an .npz file, or the folder of a TensorDict memmap",
    )
    _add_task(parser)
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="a new folder")
    parser.add_argument("--episodes", type=int, metavar="N", help="only the first N")
    parser.add_argument("--name", metavar="TEXT", help="what to call the source in the card")
    parser.add_argument(
        "--without-actions",
        action="store_true",
        help="take states alone, also of a source that has no actions",
    )


def _export(kinds: Any) -> None:
    parser = _add(kinds, "export", _run_export)
    parser.add_argument("path", metavar="FOLDER", type=Path, help="the folder of a demonstration")
    goal = parser.add_mutually_exclusive_group(required=True)
    goal.add_argument("--minari", metavar="NAME", help="a new dataset, as in cartpole/expert-v0")
    goal.add_argument("--npz", type=Path, metavar="FILE.npz", help="a new file")
    _add_task(parser)


def _play(kinds: Any) -> None:
    parser = _add(kinds, "play", _run_play)
    _add_task(parser)
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="a new folder")
    parser.add_argument("--episodes", type=int, default=1, metavar="N", help="how many; 1")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="root of the games' seeds")
    parser.add_argument(
        "--lives",
        choices=("first", "all"),
        default="first",
        help="an episode is a game's first life, or the whole game",
    )


def _run_show(args: Namespace) -> None:
    """Print what a demonstration holds."""
    args.path = _found_folder(args.path)
    _check_picture(args.out, args.fps)
    from giril_rl.demos import Demonstration
    from giril_rl.demos.show import describe

    found = Demonstration.load(args.path)
    if args.out is not None:
        from giril_rl.demos.show import write_gif

        write_gif(found, args.out, args.fps)
    print(describe(found))


def _run_import(args: Namespace) -> None:
    """Make a demonstration of a data set, checked against its task."""
    _check_new(args.out)
    check_number("--episodes", args.episodes, least=1)
    _import_modules(args)
    from giril_rl.config.tasks import named_task
    from giril_rl.demos.importing import import_demonstration

    task = named_task(args.task, args.env_id)
    found = import_demonstration(
        args.source,
        task,
        episodes=args.episodes,
        name=args.name,
        actions=not args.without_actions,
    )
    found.save(args.out)
    print(f"{args.out} has {len(found):,} transitions, {found.num_episodes:,} episodes.")
    print(f"replay: {found.card['replay']}")


def _run_export(args: Namespace) -> None:
    """Write a demonstration for others, as a Minari dataset or a plain file."""
    args.path = _found_folder(args.path)
    from giril_rl.demos import Demonstration, to_minari, to_npz

    found = Demonstration.load(args.path)
    if args.npz is not None:
        to_npz(found, args.npz)
        print(f"{args.npz} has {len(found):,} transitions, {found.num_episodes:,} episodes.")
        return
    _import_modules(args)
    from giril_rl.config.tasks import named_task
    from giril_rl.envs import as_recorded_task, gym_factory

    env_id = args.env_id
    if args.task is None and env_id is None:
        env_id = found.card.get("env_id")
        if not isinstance(env_id, str):
            raise UserError(
                f"{args.path} does not say what environment it is of: give --task NAME or "
                "--env-id ID."
            )
    task = as_recorded_task(named_task(args.task, env_id), found.card.get("lives"))
    to_minari(found, args.minari, gym_factory(task))
    print(f"{args.minari} has {len(found):,} transitions, {found.num_episodes:,} episodes.")


def _run_play(args: Namespace) -> None:
    """Play an Atari game by hand, and record it."""
    _check_new(args.out)
    check_number("--episodes", args.episodes, least=1)
    check_number("--seed", args.seed, least=0)
    _import_modules(args)
    from giril_rl.config.tasks import named_task
    from giril_rl.demos.play import Window, play_demonstration
    from giril_rl.envs import as_recorded_task, gym_factory

    task = as_recorded_task(named_task(args.task, args.env_id), args.lives)
    if task.family.observation != "image":
        raise UserError(f"{task.name} shows no images: only games can be played by hand.")
    make_fn = gym_factory(task)
    found = play_demonstration(
        make_fn,
        Window(task.name),
        episodes=args.episodes,
        seed=args.seed,
        task=task.name,
        lives=args.lives,
    )
    found.save(args.out)
    print(f"{args.out} has {len(found):,} transitions, score {found.returns.tolist()}.")


def _found_folder(path: Path) -> Path:
    folder = path
    if str(path).partition(":")[0] == "shipped":
        from giril_rl.demos.shipped import demonstration_folder

        folder = demonstration_folder(path)
    if not (folder / "card.json").is_file():
        raise UserError(
            f"{path} is not the folder of a demonstration: recipes keep theirs in "
            "runs/demos/TASK/HASH."
        )
    return folder


def _check_new(out: Path) -> None:
    """Refuses before the work what saving would refuse after it."""
    if out.is_file() or (out.is_dir() and any(out.iterdir())):
        raise UserError(f"{out} is there already: choose another folder, or delete it.")


def _check_picture(out: Path | None, fps: int) -> None:
    if not 1 <= fps <= FASTEST:
        raise UserError(f"--fps {fps}: from 1 to {FASTEST} is possible.")
    if out is None:
        return
    if out.suffix.lower() != ".gif":
        raise UserError(f"--out {out} does not end in .gif: frames are written as a GIF.")
    if not out.parent.is_dir():
        raise UserError(f"{out} cannot be written: there is no folder {out.parent}.")
