"""Local Minari datasets, read as the plain HDF5 that they are.

Minari's own reader makes an environment that the dataset's metadata names where spaces are missing
there, which runs code that a file chooses, and follows links out of the dataset. This one reads
the arrays that are needed and nothing else.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from giril_rl.demos.arrays import from_episodes
from giril_rl.demos.npz import MOST_PACKED
from giril_rl.errors import UserError
from giril_rl.files.untrusted import check_memory, parse_json, read_text

_NAME = re.compile(r"[-\w]+(/[-\w]+)*-v\d+", re.ASCII)
_ARRAYS = {
    "observations": "observations",
    "actions": "actions",
    "rewards": "rewards",
    "terminated": "terminations",
    "truncated": "truncations",
}


def minari_root() -> Path:
    """The folder that local datasets are in: ``MINARI_DATASETS_PATH``, or Minari's default."""
    given = os.environ.get("MINARI_DATASETS_PATH")
    return Path(given) if given is not None else Path.home() / ".minari" / "datasets"


def check_name(name: str) -> None:
    """Refuses what is no id of a dataset; such a one cannot leave the folder of datasets.

    Examples:
        >>> check_name("cartpole/expert-v0")
        >>> check_name("../secrets-v0")
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: '../secrets-v0' is not ... such as "cartpole/expert-v0".
    """
    if not _NAME.fullmatch(name):
        raise UserError(
            f'{name!r} is not the id of a Minari dataset: it is such as "cartpole/expert-v0".'
        )


def read_minari(name: str, episodes: int | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
    """Columns for :func:`~giril_rl.demos.arrays.to_transitions`, and a card of untrusted values.

    Args:
        name: the dataset's id.
        episodes: how many to read, the first ones; all if None.

    Raises:
        UserError: if h5py is missing, or the dataset is not there, damaged or of another kind.

    Examples:
        >>> columns, card = read_minari("cartpole/expert-v0")  # doctest: +SKIP
    """
    check_name(name)
    try:
        import h5py
    except ImportError:
        raise UserError(
            'a Minari import needs the package h5py: pip install "giril-rl[minari]".'
        ) from None
    folder = minari_root() / name / "data"
    path = folder / "main_data.hdf5"
    metadata = _metadata(folder / "metadata.json", name)
    if metadata.get("data_format", "hdf5") != "hdf5" or not path.is_file():
        raise UserError(
            f"the Minari dataset {name} has no main_data.hdf5: only its HDF5 format can be read."
        )
    try:
        with h5py.File(path, "r") as file:
            return _read(h5py, file, name, metadata, episodes)
    except UserError:
        raise
    except Exception as error:  # HDF5 raises nearly anything about a damaged file.
        reason = " ".join(str(error).split())
        raise UserError(
            f"the Minari dataset {name} is damaged or was cut short ({reason}): fetch it anew."
        ) from None


def _metadata(path: Path, name: str) -> dict[str, Any]:
    if not path.is_file():
        raise UserError(
            f"there is no local Minari dataset {name}: `minari list local` shows them, "
            "`minari download` fetches one."
        )
    try:
        metadata = parse_json(read_text(path))
    except (OSError, ValueError):
        metadata = None
    if not isinstance(metadata, dict):
        raise UserError(f"the Minari dataset {name} has damaged metadata: fetch it anew.")
    return metadata


def _read(
    h5py: Any, file: Any, name: str, metadata: dict[str, Any], episodes: int | None
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    held, said = len(file), metadata.get("total_episodes")
    if said != held:
        raise UserError(
            f"the Minari dataset {name} says that it has {said} episodes and has {held}: it was "
            "cut short, fetch it anew."
        )
    if not held:
        raise UserError(f"the Minari dataset {name} is empty: at least 2 transitions are needed.")
    found, seeds = [], []
    for number in range(held if episodes is None else min(held, episodes)):
        group = _inside(h5py, file, f"episode_{number}", name)
        found.append({ours: _array(h5py, group, theirs, name) for ours, theirs in _ARRAYS.items()})
        seeds.append(group.attrs.get("seed"))
    try:
        card = parse_json(metadata.get("description") or "{}")
    except (ValueError, TypeError):
        card = {}  # Most descriptions are prose.
    card = card if isinstance(card, dict) else {}
    if card.get("last_cut") is True and len(found) == held:
        last = found[-1]["truncated"]
        last[-1:] = False
    if all(isinstance(seed, np.integer) for seed in seeds):
        card["seeds"] = [int(seed) for seed in seeds]
    columns = from_episodes(found)
    if card.get("rewards") is False:
        del columns["reward"]
    return columns, card


def _inside(h5py: Any, group: Any, key: str, name: str) -> Any:
    """What ``key`` is in ``group``, unless it lies somewhere else."""
    if not isinstance(group, h5py.Group):
        raise UserError(f"the Minari dataset {name} has no episodes as Minari writes them.")
    link = group.get(key, getlink=True)
    if link is None:
        raise UserError(f"the Minari dataset {name} has no {key}: it is damaged, fetch it anew.")
    if not isinstance(link, h5py.HardLink):
        raise UserError(f"the Minari dataset {name} has a link for {key}: only data is read.")
    return group[key]


def _array(h5py: Any, group: Any, key: str, name: str) -> np.ndarray:
    data = _inside(h5py, group, key, name)
    if not isinstance(data, h5py.Dataset):
        raise UserError(
            f"the Minari dataset {name} has {key} of several parts (a Dict or Tuple space): only "
            "vectors, images and discrete actions are demonstrations here."
        )
    if data.external or data.is_virtual:
        raise UserError(f"the Minari dataset {name} has {key} in another file: only data is read.")
    if data.dtype.kind not in "fiub":
        raise UserError(
            f"the Minari dataset {name} has {key} of {data.dtype}, not plain numbers: images that "
            "are JPEG-encoded are not those that were seen."
        )
    if data.nbytes > MOST_PACKED * max(data.id.get_storage_size(), 1):
        raise UserError(f"the Minari dataset {name} has {key} larger than its file: fetch it anew.")
    check_memory(f"the Minari dataset {name}", data.nbytes)
    return np.asarray(data[()])
