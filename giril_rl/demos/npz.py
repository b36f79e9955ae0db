"""Demonstrations as ``.npz`` files of plain arrays: import and export."""

from __future__ import annotations

import contextlib
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from giril_rl.config.nearest import did_you_mean
from giril_rl.demos.arrays import (
    NEEDED,
    check_names,
    from_episodes,
    needed,
    parse_card,
    renamed,
)
from giril_rl.demos.demonstration import Demonstration
from giril_rl.demos.storage import BROKEN, MOST_PACKED, npy_header
from giril_rl.errors import UserError
from giril_rl.files.disk import sync, temporary_sibling
from giril_rl.files.untrusted import check_memory

EPISODES = ("observations", "actions", "lengths", "terminated")
_KNOWN = {*NEEDED, "reward", *EPISODES, "rewards", "card"}


def read_npz(path: Path, *, actions: bool = True) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Columns for :func:`~giril_rl.demos.arrays.to_transitions`, and a card of untrusted values.

    Nothing is unpickled, and nothing is read before its size is known. The file has one of two
    forms.

    - One row per transition: ``observation``, ``action``, ``next_observation``, ``terminated`` and
      ``truncated`` [N, ...], ``reward`` if known.
    - Whole episodes, concatenated: ``observations`` [N + E, ...], T + 1 rows for an episode of T
      actions, ``actions`` [N, ...], ``lengths`` int [E], ``terminated`` bool [E] (the other
      episodes ended at a time limit), ``rewards`` [N] if known.

    With ``actions=False`` there may be no actions.

    Raises:
        UserError: for a file that is damaged, or holds anything else.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "two_episodes.npz"
        >>> np.savez(path, observations=np.zeros((5, 4)), actions=np.array([0, 1, 1]),
        ...          lengths=np.array([2, 1]), terminated=np.array([True, False]))
        >>> read_npz(path)[0]["truncated"].tolist()
        [False, False, True]
    """
    if not path.is_file():
        raise UserError(f"there is no file {path}: name an .npz file.")
    try:
        with zipfile.ZipFile(path) as archive:
            names = _names(archive, actions)
            check_memory(path.name, sum(member.file_size for member in archive.infolist()))
            arrays = {name: _array(archive, name) for name in names}
    except BROKEN as error:
        raise UserError(
            f"{path.name} is no .npz file, or was cut short ({error}): write it anew."
        ) from None
    card = arrays.pop("card", np.empty(0))
    return (_whole(arrays) if "lengths" in arrays else arrays), parse_card(card.tobytes())


def to_npz(demo: Demonstration, path: Path | str) -> None:
    """Writes a demonstration, one row per transition; an import gives the same bits back.

    Args:
        demo: what to export; unknown rewards, and actions that it has not, are left out.
        path: a new file, ending in ``.npz``.

    Raises:
        UserError: if the file exists, or its name ends otherwise.

    Examples:
        >>> demo = Demonstration.load("runs/demos/cartpole/0a1b")  # doctest: +SKIP
        >>> to_npz(demo, "cartpole.npz")  # doctest: +SKIP
    """
    path = Path(path)
    if path.suffix != ".npz":
        raise UserError(f"{path} does not end in .npz: name the file so.")
    if path.exists():
        raise UserError(f"{path} is there already: choose another name, or delete it.")
    if not path.parent.is_dir():
        raise UserError(f"{path} cannot be written: there is no folder {path.parent}.")
    after = demo.transitions["next"]
    columns = {
        "observation": demo.transitions["observation"],
        "next_observation": after["observation"],
        "terminated": after["terminated"].reshape(-1),
        "truncated": after["truncated"].reshape(-1),
    }
    if demo.has_actions:
        columns["action"] = demo.transitions["action"]
    if demo.has_rewards:
        columns["reward"] = after["reward"].reshape(-1)
    arrays = {name: column.cpu().numpy() for name, column in columns.items()}
    arrays["card"] = np.frombuffer(json.dumps(demo.card).encode(), np.uint8)
    temporary = temporary_sibling(path)
    try:
        with open(temporary, "wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)
        sync(temporary)
        temporary.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise


def _names(archive: zipfile.ZipFile, actions: bool) -> list[str]:
    files = [member.filename for member in archive.infolist()]
    names = [file.removesuffix(".npy") for file in files]
    for file, name in zip(files, names, strict=True):
        if names.count(name) > 1:
            raise UserError(f"the .npz file holds {file!r} twice: write it anew.")
        if file == name:
            raise UserError(f"{file!r} in the .npz file is not an array: leave it out.")
    _check_names(names, actions)
    return names


def _check_names(names: list[str], actions: bool) -> None:
    """Refuses names of neither form, and a form that is not complete."""

    def likeness(form: tuple[str, ...]) -> tuple[int, int]:
        same = len(set(form) & set(names))
        return same + len(renamed(names, form)), same

    whole = "lengths" in names
    form = EPISODES if whole else max(NEEDED, EPISODES, key=likeness)
    check_names(
        names,
        needed(form, actions=actions),
        f"the .npz file has {'lengths and ' if whole else ''}no",
    )
    for name in names:
        if name not in _KNOWN:
            hint = did_you_mean(name, _KNOWN) or "; leave it out."
            raise UserError(
                f"'{name}.npy' in the .npz file is not an array of a demonstration{hint}"
            )


def _array(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    member = archive.getinfo(f"{name}.npy")
    _, dtype, _, size = npy_header(archive, name)
    if dtype.hasobject or dtype.kind not in "fiub":
        raise UserError(
            f"{name} in the .npz file is of {dtype}, not plain numbers: nothing is unpickled, so "
            "save arrays of numbers."
        )
    if member.file_size != size or size > MOST_PACKED * max(member.compress_size, 1):
        raise ValueError(f"{name} has not the size that it says")
    with archive.open(member) as file:
        return np.lib.format.read_array(file, allow_pickle=False)


def _whole(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Columns of a file of whole episodes."""
    foreign = sorted(set(arrays) - {*EPISODES, "rewards"})
    if foreign:
        raise UserError(
            f"the .npz file has both lengths, for whole episodes, and {foreign[0]}, for single "
            "transitions: leave one out."
        )
    lengths, ended = arrays["lengths"], arrays["terminated"]
    observations = arrays["observations"]
    if (
        lengths.ndim != 1
        or lengths.dtype.kind not in "iu"
        or (lengths < 1).any()
        or not len(lengths)
    ):
        raise UserError("lengths in the .npz file must be integers of at least 1, one per episode.")
    if ended.dtype != np.bool_ or ended.shape != lengths.shape:
        raise UserError(
            "terminated in the .npz file must be bool, one per episode, as lengths is: true where "
            "the episode ended by itself."
        )
    total, count = sum(lengths.tolist()), len(lengths)
    rows: dict[str, np.ndarray] = {
        name: arrays[name] for name in ("actions", "rewards") if name in arrays
    }
    wanted_rows = {"observations": total + count, **dict.fromkeys(rows, total)}
    for name, wanted in wanted_rows.items():
        found = len(arrays[name]) if arrays[name].ndim else 0
        if found != wanted:
            raise UserError(
                f"the .npz file has {found} rows of {name} and lengths ask for {wanted} "
                f"({total} steps in {count} episodes, one observation more than actions in each): "
                "next states are missing, or an episode is cut."
            )
    episodes, start = [], 0
    for number, length in enumerate(lengths.tolist()):
        part = slice(start, start + length)
        last = np.arange(length) == length - 1
        episode = {name: array[part] for name, array in rows.items()}
        episode["observations"] = observations[start + number : start + number + length + 1]
        episode["terminated"], episode["truncated"] = last & ended[number], last & ~ended[number]
        episodes.append(episode)
        start += length
    return from_episodes(episodes)
