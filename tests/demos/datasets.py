"""Data sets of others, right and wrong, in the three formats that can be imported."""

import json

import numpy as np
import torch
from tensordict import TensorDict

ENV = "Pendulum-v1"  # Observations [3], actions [1] in [-2, 2].


def episodes():
    """Two episodes of 3 and 2 steps; the second one ended at a time limit."""
    rng = np.random.default_rng(0)
    return [
        {
            "observations": rng.uniform(-1, 1, (length + 1, 3)).astype(np.float32),
            "actions": rng.uniform(-2, 2, (length, 1)).astype(np.float32),
            "rewards": rng.uniform(-1, 0, length).astype(np.float32),
            "terminations": np.arange(length) == end,
            "truncations": np.arange(length) == 1 if end < 0 else np.zeros(length, bool),
        }
        for length, end in ((3, 2), (2, -1))
    ]


def columns():
    """The same, one row per transition."""
    parts = episodes()
    return {
        "observation": np.concatenate([part["observations"][:-1] for part in parts]),
        "action": np.concatenate([part["actions"] for part in parts]),
        "next_observation": np.concatenate([part["observations"][1:] for part in parts]),
        "reward": np.concatenate([part["rewards"] for part in parts]),
        "terminated": np.concatenate([part["terminations"] for part in parts]),
        "truncated": np.concatenate([part["truncations"] for part in parts]),
    }


def whole():
    """The same, as episodes one after another."""
    parts = episodes()
    return {
        "observations": np.concatenate([part["observations"] for part in parts]),
        "actions": np.concatenate([part["actions"] for part in parts]),
        "rewards": np.concatenate([part["rewards"] for part in parts]),
        "lengths": np.array([3, 2]),
        "terminated": np.array([True, False]),
    }


def tensors():
    """The same, as a TensorDict."""
    found = {name: torch.from_numpy(value) for name, value in columns().items()}
    after = {
        "observation": found["next_observation"],
        "reward": found["reward"][:, None],
        "terminated": found["terminated"][:, None],
        "truncated": found["truncated"][:, None],
        "done": (found["terminated"] | found["truncated"])[:, None],
    }
    return TensorDict(
        {"observation": found["observation"], "action": found["action"], "next": after}, [5]
    )


def write_minari(root, name, parts, **metadata):
    """A dataset as Minari lays it out; None in ``metadata`` leaves the entry out."""
    import h5py

    folder = root / name / "data"
    folder.mkdir(parents=True)
    said = {"data_format": "hdf5", "total_episodes": len(parts), "dataset_id": name, **metadata}
    (folder / "metadata.json").write_text(json.dumps(said))
    with h5py.File(folder / "main_data.hdf5", "w") as file:
        for number, part in enumerate(parts):
            group = file.create_group(f"episode_{number}")
            for key, value in part.items():
                group[key] = value
    return folder
