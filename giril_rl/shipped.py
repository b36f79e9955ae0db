"""The demonstrations that come with the package, so that nobody needs an expert to begin."""

from __future__ import annotations

from pathlib import Path

from giril_rl.configs import TaskConfig
from giril_rl.errors import UserError
from giril_rl.files import read_json
from giril_rl.nearest import did_you_mean

SHIPPED = "shipped"
"""Stands for a path: ``shipped`` is the task's demonstration, ``shipped:NAME`` that of NAME."""
_FOLDER = Path(__file__).parent / "demos" / "data"


def shipped_demonstrations() -> dict[str, Path]:
    """Folders of the shipped demonstrations by their task's name.

    Examples:
        >>> shipped_demonstrations()["breakout"].name
        'breakout'
    """
    return {card.parent.name: card.parent for card in sorted(_FOLDER.glob("*/card.json"))}


def is_shipped(path: Path | str) -> bool:
    """Whether a user's path means a demonstration of the package.

    Examples:
        >>> is_shipped("shipped:breakout"), is_shipped("./shipped")
        (True, False)
    """
    return str(path).partition(":")[0] == SHIPPED


def demonstration_folder(path: Path | str, task: TaskConfig | None = None) -> Path:
    """The folder that a user's path means.

    Args:
        path: a folder, ``shipped:NAME``, or ``shipped`` for the one of ``task``.
        task: the task that is to be learned.

    Raises:
        UserError: if no such demonstration is shipped.

    Examples:
        >>> demonstration_folder("shipped:breakout") == shipped_demonstrations()["breakout"]
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
    name = str(path).partition(":")[2]
    found = shipped_demonstrations()
    if not name and task is not None:
        ids = {
            read_json(place / "card.json").get("env_id"): known for known, place in found.items()
        }
        name = ids.get(task.env_id, task.name)
    if name not in found:
        hint = did_you_mean(name, found) or f": there are {', '.join(found)}."
        raise UserError(f"no demonstration of {name or 'that name'} is shipped{hint}")
    return found[name]
