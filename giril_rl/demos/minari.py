"""Demonstrations as Minari datasets, for other libraries to read."""

from __future__ import annotations

import json
import os
import shutil
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import gymnasium
import torch
from torch import Tensor

from giril_rl.demos.check import check_demonstration
from giril_rl.demos.demonstration import Demonstration
from giril_rl.demos.minari_read import check_name, minari_root
from giril_rl.demos.storage import check_room
from giril_rl.errors import UserError
from giril_rl.files.disk import temporary_sibling, write_atomically

PART_BYTES = 16 * 2**20
"""Of a demonstration, handed to Minari at a time: what an export needs besides it."""
_OVERHEAD = 4096
"""Bytes that HDF5 needs for each array of an episode, at most."""


def to_minari(
    demo: Demonstration,
    dataset_id: str,
    make_fn: Callable[[], gymnasium.Env],
    *,
    algorithm_name: str | None = None,
    **metadata: Any,
) -> Any:
    """Write a demonstration as the local Minari dataset ``dataset_id``.

    An episode of T actions has T + 1 observations there, the terminal one included. A last episode
    that was cut at the demonstration's length is marked as truncated, which Minari's readers expect
    of every episode. The card is the dataset's description. The place is Minari's own, set by the
    environment variable ``MINARI_DATASETS_PATH``. Images are written as they are, whole stacks; of
    an Atari game the environment that Minari recovers is the bare one, without the preprocessing.
    Of an environment that is registered by its class, not as ``"module:Class"``, only the spaces
    are written. Memory does not grow with the demonstration: it is written in parts.

    Args:
        demo: what to export.
        dataset_id: such as ``"inverted_pendulum/expert-v0"``.
        make_fn: makes the environment, whose spaces and spec go into the dataset.
        algorithm_name: what the expert is, such as ``"PPO"``.
        **metadata: further arguments of ``minari.create_dataset_from_buffers``, such as ``author``.

    Returns:
        The ``minari.MinariDataset``.

    Raises:
        UserError: if Minari is not installed or refuses the name, or the demonstration has a
            fault.
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
    check_demonstration(demo)
    # Only an export is to give the cut back: to others it is a truncation.
    card = demo.card if demo.transitions["next", "done"][-1] else {**demo.card, "last_cut": True}
    arguments = {"algorithm_name": algorithm_name, "description": json.dumps(card), **metadata}
    root = minari_root()
    check_room(root / dataset_id, demo.transitions, more=_OVERHEAD * demo.num_episodes)
    root.mkdir(parents=True, exist_ok=True)
    temporary = temporary_sibling(root / "export").resolve()  # Minari mistakes relative ones.
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
    """The storage of a dataset without episodes, beside all others."""
    import minari

    env = make_fn()
    try:
        if (minari_root() / dataset_id).exists():
            raise ValueError("it is there already")
        with patch.dict(os.environ, MINARI_DATASETS_PATH=str(temporary)), warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # An author's name is nobody's duty.
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
    except (ValueError, TypeError):  # The spec holds a class, which no text stands for.
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
            observations=_array(observations),
            actions=_array(part["action"]),
            rewards=_array(part["next", "reward"].reshape(-1).double()),
            terminations=_array(part["next", "terminated"].reshape(-1)),
            truncations=_array(truncated),
        )

    for part in _parts(lengths, most):
        storage.update_episodes(buffer(*piece) for piece in part)
    # Of an episode in pieces Minari counts the last one alone.
    cut = [episode for episode, length in enumerate(lengths) if length > most]
    if cut:
        storage.update_episode_metadata([{"total_steps": lengths[i]} for i in cut], cut)


def _array(tensor: Tensor) -> Any:
    return tensor.detach().cpu().numpy()


def _parts(lengths: Iterable[int], most: int) -> Iterator[list[tuple[int, slice]]]:
    """Pieces of episodes, their rows, in parts of at most ``most`` rows.

    Only an episode that is longer than that is cut, from its beginning: by the size of its first
    piece HDF5 chooses how the episode is stored.

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
    """Moves a whole dataset to where Minari looks for it."""
    for part in reversed(Path(dataset_id).parents[:-1]):
        (root / part).mkdir(exist_ok=True)
        note = root / part / "namespace_metadata.json"
        if not note.exists():
            write_atomically(note, "{}")
    (temporary / dataset_id).replace(root / dataset_id)
