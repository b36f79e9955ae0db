"""Demonstrations as Minari datasets, for other libraries to read."""

from __future__ import annotations

import json
import os
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import gymnasium
import torch

from giril_rl.demos.demonstration import Demonstration
from giril_rl.demos.minari_read import check_name, minari_root
from giril_rl.errors import UserError
from giril_rl.files import temporary_sibling, write_atomically


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

    Args:
        demo: what to export.
        dataset_id: such as ``"inverted_pendulum/expert-v0"``.
        make_fn: makes the environment, whose spaces and spec go into the dataset.
        algorithm_name: what the expert is, such as ``"PPO"``.
        **metadata: further arguments of ``minari.create_dataset_from_buffers``, such as ``author``.

    Returns:
        The ``minari.MinariDataset``.

    Raises:
        UserError: if Minari is not installed, or refuses the name.

    Examples:
        >>> demo = Demonstration.load("demos/cartpole")  # doctest: +SKIP
        >>> make_fn = lambda: gymnasium.make("CartPole-v1")
        >>> to_minari(demo, "cartpole/expert-v0", make_fn).total_episodes  # doctest: +SKIP
        5
    """
    try:
        import minari
        from minari.data_collector import EpisodeBuffer
    except ImportError:
        raise UserError(
            'a Minari export needs the package minari: pip install "giril-rl[minari]".'
        ) from None
    check_name(dataset_id)
    data = demo.transitions
    buffers = []
    seeds = demo.card.get("seeds") or [None] * demo.num_episodes
    for episode, seed in enumerate(seeds):
        part = data[data["episode"] == episode]
        truncated = part["next", "truncated"].reshape(-1).clone()
        truncated[-1] |= ~part["next", "done"][-1, 0]
        observations = torch.cat([part["observation"], part["next", "observation"][-1:]])
        buffers.append(
            EpisodeBuffer(
                id=episode,
                seed=seed,
                observations=observations.numpy(),
                actions=part["action"].numpy(),
                rewards=part["next", "reward"].reshape(-1).tolist(),
                terminations=part["next", "terminated"].reshape(-1).tolist(),
                truncations=truncated.tolist(),
            )
        )
    # Only an export is to give the cut back: to others it is a truncation.
    card = demo.card if demo.transitions["next", "done"][-1] else {**demo.card, "last_cut": True}
    arguments = {"algorithm_name": algorithm_name, "description": json.dumps(card), **metadata}
    env = make_fn()
    try:
        _create(minari, dataset_id, buffers, env, arguments)
    except (ValueError, AssertionError) as error:
        raise UserError(
            f"Minari refuses {dataset_id!r} ({error}): give a new name such as "
            '"cartpole/expert-v0".'
        ) from None
    finally:
        env.close()
    return minari.load_dataset(dataset_id)


def _create(
    minari: Any, dataset_id: str, buffers: list[Any], env: gymnasium.Env, arguments: dict[str, Any]
) -> None:
    """Writes the dataset beside all others, then moves it to where Minari looks for it."""
    root = minari_root()
    folder = root / dataset_id
    if folder.exists():
        raise ValueError("it is there already")
    root.mkdir(parents=True, exist_ok=True)
    temporary = temporary_sibling(root / "export").resolve()  # Minari mistakes relative ones.
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        with patch.dict(os.environ, MINARI_DATASETS_PATH=str(temporary)), warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # An author's name is nobody's duty.
            minari.create_dataset_from_buffers(
                dataset_id, buffers, env=env, jpeg_encoding=False, **arguments
            )
        for part in reversed(Path(dataset_id).parents[:-1]):
            (root / part).mkdir(exist_ok=True)
            note = root / part / "namespace_metadata.json"
            if not note.exists():
                write_atomically(note, "{}")
        (temporary / dataset_id).replace(folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
