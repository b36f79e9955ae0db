"""Demonstrations as local Minari datasets: export with Minari, import of the plain HDF5.

Minari's own reader makes the environment that a dataset's metadata names where spaces are missing,
which runs code that a file chooses, and follows links out of the dataset. The reader here reads the
arrays that are needed and nothing else.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import gymnasium
import numpy as np
import torch
from torch import Tensor

from giril_rl.demos.arrays import from_episodes, parse_card
from giril_rl.demos.demonstration import Demonstration
from giril_rl.demos.storage import MOST_PACKED, check_room
from giril_rl.errors import UserError
from giril_rl.files.disk import temporary_sibling, write_atomically
from giril_rl.files.untrusted import check_memory, parse_json, read_text

PART_BYTES = 16 * 2**20
"""Size of the parts of a demonstration that an export hands to Minari one after another."""
_OVERHEAD = 4096
"""Bytes that HDF5 needs for each array of an episode, at most."""
_NAME = re.compile(r"[-\w]+(/[-\w]+)*-v\d+", re.ASCII)
_ARRAYS = {
    "observations": "observations",
    "actions": "actions",
    "rewards": "rewards",
    "terminated": "terminations",
    "truncated": "truncations",
}


def minari_root() -> Path:
    """The folder of local datasets: ``MINARI_DATASETS_PATH``, or Minari's default."""
    given = os.environ.get("MINARI_DATASETS_PATH")
    return Path(given) if given is not None else Path.home() / ".minari" / "datasets"


def check_name(name: str) -> None:
    """Refuses what is not a dataset's id; an id cannot lead out of the folder of datasets.

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


def to_minari(
    demo: Demonstration,
    dataset_id: str,
    make_fn: Callable[[], gymnasium.Env],
    *,
    algorithm_name: str | None = None,
    **metadata: Any,
) -> Any:
    """Writes a demonstration as the local Minari dataset ``dataset_id``.

    An episode of T actions has T + 1 observations, the terminal one included. A last episode that
    was cut at the demonstration's length is marked as truncated, as Minari's readers expect an end
    of every episode. The card is the dataset's description. The folder is Minari's own
    (``MINARI_DATASETS_PATH``). Memory does not grow with the demonstration: it is written in parts.

    Images are written as whole stacks. Of an Atari game, Minari recovers the bare environment
    without the preprocessing; of an environment that is registered by its class, not as
    ``"module:Class"``, only the spaces.

    Args:
        demo: what to export.
        dataset_id: such as ``"inverted_pendulum/expert-v0"``.
        make_fn: makes the environment, whose spaces and spec go into the dataset.
        algorithm_name: the expert's algorithm, such as ``"PPO"``.
        **metadata: further arguments of ``minari.create_dataset_from_buffers``, such as ``author``.

    Returns:
        The ``minari.MinariDataset``.

    Raises:
        UserError: if Minari is not installed or refuses the name, or the demonstration has a
            fault or no actions.
        OSError: ENOSPC if there is not room for it.

    Examples:
        >>> demo = Demonstration.load("demos/cartpole")  # doctest: +SKIP
        >>> make_fn = lambda: gymnasium.make("CartPole-v1")
        >>> to_minari(demo, "cartpole/expert-v0", make_fn).total_episodes  # doctest: +SKIP
        5
    """
    try:
        import minari
    except ImportError:
        raise UserError(
            'a Minari export needs the package minari: pip install "giril-rl[minari]".'
        ) from None
    check_name(dataset_id)
    if not demo.has_actions:
        raise UserError(
            "a Minari dataset has actions and this demonstration has none: export it with --npz."
        )
    demo.check()
    # To others the cut is a truncation; our import undoes it.
    card = demo.card if demo.transitions["next", "done"][-1] else {**demo.card, "last_cut": True}
    arguments = {"algorithm_name": algorithm_name, "description": json.dumps(card), **metadata}
    root = minari_root()
    check_room(root / dataset_id, demo.transitions, more=_OVERHEAD * demo.num_episodes)
    root.mkdir(parents=True, exist_ok=True)
    temporary = temporary_sibling(root / "export").resolve()  # Minari misreads relative paths.
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        _write(demo, _begin(dataset_id, temporary, make_fn, arguments))
        _publish(temporary, root, dataset_id)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return minari.load_dataset(dataset_id)


def _begin(
    dataset_id: str,
    temporary: Path,
    make_fn: Callable[[], gymnasium.Env],
    arguments: dict[str, Any],
) -> Any:
    """The storage of a dataset without episodes, in a temporary folder beside the others."""
    import minari

    env = make_fn()
    try:
        if (minari_root() / dataset_id).exists():
            raise ValueError("it is there already")
        with patch.dict(os.environ, MINARI_DATASETS_PATH=str(temporary)), warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # Of a missing author.
            return minari.create_dataset_from_buffers(
                dataset_id, [], jpeg_encoding=False, **{**_environment(env), **arguments}
            ).storage
    except (ValueError, AssertionError) as error:
        raise UserError(
            f"Minari refuses {dataset_id!r} ({error}): give a new name such as "
            '"cartpole/expert-v0".'
        ) from None
    finally:
        env.close()


def _environment(env: gymnasium.Env) -> dict[str, Any]:
    spaces = {"observation_space": env.observation_space, "action_space": env.action_space}
    try:
        return {"env": env, **spaces} if env.spec is not None and env.spec.to_json() else spaces
    except (ValueError, TypeError):  # A spec with a class cannot be written as text.
        return spaces


def _write(demo: Demonstration, storage: Any) -> None:
    from minari.data_collector import EpisodeBuffer

    data, lengths = demo.transitions, demo.lengths.tolist()
    tensors = data.values(include_nested=True, leaves_only=True)
    most = max(1, PART_BYTES // sum(x[0].numel() * x.element_size() for x in tensors))
    if storage.FORMAT != "hdf5":  # Others replace an episode where HDF5 appends to it.
        most = max(most, *lengths)
    ends = demo.lengths.cumsum(0).tolist()
    seeds = demo.card.get("seeds")
    if not isinstance(seeds, list) or len(seeds) != len(lengths):
        seeds = [None] * len(lengths)

    def buffer(episode: int, rows: slice) -> EpisodeBuffer:
        part = data[rows]
        truncated, observations = part["next", "truncated"].reshape(-1), part["observation"]
        if rows.stop == ends[episode]:
            observations = torch.cat([observations, part["next", "observation"][-1:]])
            truncated = truncated.clone()
            truncated[-1] |= ~part["next", "done"][-1, 0]
        return EpisodeBuffer(
            id=episode,
            seed=seeds[episode] if rows.start == ends[episode] - lengths[episode] else None,
            observations=_numpy(observations),
            actions=_numpy(part["action"]),
            rewards=_numpy(part["next", "reward"].reshape(-1).double()),
            terminations=_numpy(part["next", "terminated"].reshape(-1)),
            truncations=_numpy(truncated),
        )

    for part in _parts(lengths, most):
        storage.update_episodes(buffer(*piece) for piece in part)
    # Of an episode in pieces, Minari counts only the last piece.
    cut = [episode for episode, length in enumerate(lengths) if length > most]
    if cut:
        storage.update_episode_metadata([{"total_steps": lengths[i]} for i in cut], cut)


def _numpy(tensor: Tensor) -> Any:
    return tensor.detach().cpu().numpy()


def _parts(lengths: Iterable[int], most: int) -> Iterator[list[tuple[int, slice]]]:
    """Parts of at most ``most`` rows, each a list of episodes (or pieces of one) and their rows.

    Only a longer episode is cut, from its beginning: HDF5 chooses by the size of the first piece
    how the episode is stored.

    Examples:
        >>> [[(i, rows.start, rows.stop) for i, rows in part] for part in _parts([2, 1, 2, 7], 3)]
        [[(0, 0, 2), (1, 2, 3)], [(2, 3, 5)], [(3, 5, 8)], [(3, 8, 11)], [(3, 11, 12)]]
    """
    part: list[tuple[int, slice]] = []
    held = start = 0
    for episode, length in enumerate(lengths):
        for first in range(start, start + length, most):
            rows = slice(first, min(first + most, start + length))
            if held + rows.stop - rows.start > most:
                yield part
                part, held = [], 0
            part.append((episode, rows))
            held += rows.stop - rows.start
        start += length
    yield part


def _publish(temporary: Path, root: Path, dataset_id: str) -> None:
    """Moves a finished dataset to where Minari looks for it."""
    for part in reversed(Path(dataset_id).parents[:-1]):
        (root / part).mkdir(exist_ok=True)
        note = root / part / "namespace_metadata.json"
        if not note.exists():
            write_atomically(note, "{}")
    (temporary / dataset_id).replace(root / dataset_id)


def read_minari(
    name: str, episodes: int | None = None, *, actions: bool = True
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Columns for :func:`~giril_rl.demos.arrays.to_transitions`, and a card of untrusted values.

    Args:
        name: the dataset's id.
        episodes: number of episodes to read, from the first; None reads all.
        actions: whether to read the actions; those that are not read may be of any kind.

    Raises:
        UserError: if h5py is missing, or the dataset is missing, damaged or of another kind.
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
    if not (folder / "metadata.json").is_file():
        raise UserError(
            f"there is no local Minari dataset {name}: `minari list local` shows them, "
            "`minari download` fetches one."
        )
    try:
        metadata = _metadata(folder / "metadata.json")
        if metadata.get("data_format", "hdf5") != "hdf5" or not path.is_file():
            raise _Fault("has no main_data.hdf5: only its HDF5 format can be read")
        with h5py.File(path, "r") as file:
            return _read(file, metadata, episodes, actions)
    except UserError:
        raise
    except _Fault as fault:
        raise UserError(f"the Minari dataset {name} {fault}.") from None
    except Exception as error:  # HDF5 raises all kinds for a damaged file.
        reason = " ".join(str(error).split())
        raise UserError(
            f"the Minari dataset {name} is damaged or was cut short ({reason}): fetch it anew."
        ) from None


class _Fault(Exception):
    """What is wrong with a dataset, as the end of a sentence that names it."""


def _metadata(path: Path) -> dict[str, Any]:
    try:
        metadata = parse_json(read_text(path))
    except (OSError, ValueError):
        metadata = None
    if not isinstance(metadata, dict):
        raise _Fault("has damaged metadata: fetch it anew")
    return metadata


def _read(
    file: Any, metadata: dict[str, Any], episodes: int | None, actions: bool
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    held, said = len(file), metadata.get("total_episodes")
    if said != held:
        raise _Fault(
            f"says that it has {said} episodes and has {held}: it was cut short, fetch it anew"
        )
    if not held:
        raise _Fault("is empty: at least 2 transitions are needed")
    found, seeds = [], []
    wanted = {ours: theirs for ours, theirs in _ARRAYS.items() if actions or ours != "actions"}
    for number in range(held if episodes is None else min(held, episodes)):
        group = _entry(file, f"episode_{number}")
        found.append({ours: _array(group, theirs) for ours, theirs in wanted.items()})
        seeds.append(group.attrs.get("seed"))
    card = parse_card(metadata.get("description"))  # Most descriptions are prose.
    if card.get("last_cut") is True and len(found) == held:
        found[-1]["truncated"][-1:] = False
    if all(isinstance(seed, np.integer) for seed in seeds):
        card["seeds"] = [int(seed) for seed in seeds]
    columns = from_episodes(found)
    if card.get("rewards") is False:
        del columns["reward"]
    return columns, card


def _entry(group: Any, key: str) -> Any:
    """An entry of an HDF5 group, refused if it is a link."""
    import h5py

    if not isinstance(group, h5py.Group):
        raise _Fault("has no episodes as Minari writes them")
    link = group.get(key, getlink=True)
    if link is None:
        raise _Fault(f"has no {key}: it is damaged, fetch it anew")
    if not isinstance(link, h5py.HardLink):
        raise _Fault(f"has a link for {key}: only data is read")
    return group[key]


def _array(group: Any, key: str) -> np.ndarray:
    import h5py

    data = _entry(group, key)
    if not isinstance(data, h5py.Dataset):
        raise _Fault(
            f"has {key} of several parts (a Dict or Tuple space): only vectors, images and "
            "discrete actions are demonstrations here"
        )
    if data.external or data.is_virtual:
        raise _Fault(f"has {key} in another file: only data is read")
    if data.dtype.kind not in "fiub":
        raise _Fault(
            f"has {key} of {data.dtype}, not plain numbers: images that are JPEG-encoded are not "
            "those that were seen"
        )
    if data.nbytes > MOST_PACKED * max(data.id.get_storage_size(), 1):
        raise _Fault(f"has {key} larger than its file: fetch it anew")
    check_memory(f"the Minari file {data.file.filename}", data.nbytes)
    return np.asarray(data[()])
