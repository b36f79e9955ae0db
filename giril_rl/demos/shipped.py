"""The demonstrations that come with the package, so that nobody needs an expert to begin."""

from __future__ import annotations

from pathlib import Path

from giril_rl.config.nearest import did_you_mean
from giril_rl.config.schema import TaskConfig
from giril_rl.errors import UserError
from giril_rl.files.disk import read_json

SHIPPED = "shipped"
"""Stands for a path: ``shipped`` is the task's demonstration, ``shipped:NAME`` that of NAME."""
_FOLDER = Path(__file__).parent / "data"


def shipped_demonstrations() -> dict[str, list[Path]]:
    """Folders of the shipped demonstrations by their task's name, the one of seed 0 first.

    Examples:
        >>> [folder.name for folder in shipped_demonstrations()["breakout"]]
        ['0']
    """
    found: dict[str, list[Path]] = {}
    for card in sorted(_FOLDER.glob("*/*/card.json"), key=lambda card: int(card.parent.name)):
        found.setdefault(card.parent.parent.name, []).append(card.parent)
    return dict(sorted(found.items()))


def is_shipped(path: Path | str) -> bool:
    """Whether a user's path means a demonstration of the package.

    Examples:
        >>> is_shipped("shipped:breakout"), is_shipped("./shipped")
        (True, False)
    """
    return str(path).partition(":")[0] == SHIPPED


def demonstration_folder(path: Path | str, task: TaskConfig | None = None, seed: int = 0) -> Path:
    """The folder that a user's path means.

    Args:
        path: a folder; ``shipped:NAME/INDEX``; ``shipped:NAME``, or ``shipped`` for that of
            ``task``, for the one of ``seed``. Beyond the shipped ones they are taken in turn.
        task: the task that is to be learned.
        seed: the run's seed.

    Raises:
        UserError: if no such demonstration is shipped.

    Examples:
        >>> demonstration_folder("shipped:breakout/0") == shipped_demonstrations()["breakout"][0]
        True
        >>> demonstration_folder("demos/mine")
        PosixPath('demos/mine')
        >>> demonstration_folder("shipped:pong")  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: no demonstration of pong is shipped: there are beam_rider, ...
    """
    if not is_shipped(path):
        return Path(path)
    name, slash, index = str(path).partition(":")[2].partition("/")
    found = shipped_demonstrations()
    if not name and task is not None:
        # `half_cheetah` goes before `half_cheetah-novice`, of the same environment.
        names = reversed(found.items())
        ids = {read_json(places[0] / "card.json").get("env_id"): n for n, places in names}
        name = ids.get(task.env_id, task.name)
    if name not in found:
        hint = did_you_mean(name, found) or f": there are {', '.join(found)}."
        raise UserError(f"no demonstration of {name or 'that name'} is shipped{hint}")
    count = len(found[name])
    if slash and index not in map(str, range(count)):
        known = "0" if count == 1 else f"0 to {count - 1}"
        raise UserError(f"{path}: there is no such demonstration of {name}: choose {known}.")
    return found[name][int(index) if slash else seed % count]


def demonstration_name(path: Path | str, task: TaskConfig | None = None, seed: int = 0) -> str:
    """What tells which demonstration a user's path means: ``shipped:NAME/INDEX``, or the path.

    Examples:
        >>> demonstration_name("shipped:breakout", seed=3), demonstration_name("demos/mine")
        ('shipped:breakout/0', 'demos/mine')
    """
    folder = demonstration_folder(path, task, seed)
    if not is_shipped(path):
        return str(path)
    return f"{SHIPPED}:{folder.parent.name}/{folder.name}"
