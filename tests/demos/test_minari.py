import json
import shutil
import sys

import gymnasium
import numpy as np
import pytest

from giril_rl.demos import record_demonstration, to_minari
from giril_rl.errors import UserError


def make_fn():
    return gymnasium.make("CartPole-v1")


@pytest.fixture
def cartpole():
    return record_demonstration(make_fn, lambda o: (o[:, 2] > 0).long(), length=100, seed=0)


def test_export_holds_every_transition(cartpole, tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    to_minari(cartpole, "cartpole/test-v0", make_fn, author="nobody")
    dataset = minari.load_dataset("cartpole/test-v0")
    assert dataset.total_episodes == cartpole.num_episodes > 2
    assert dataset.total_steps == 100
    start = 0
    for episode, length in zip(dataset.iterate_episodes(), cartpole.lengths.tolist(), strict=True):
        part = cartpole.transitions[start : start + length]
        assert episode.observations.shape == (length + 1, 4)
        np.testing.assert_array_equal(episode.observations[:-1], part["observation"].numpy())
        np.testing.assert_array_equal(episode.observations[1:], part["next", "observation"].numpy())
        np.testing.assert_array_equal(episode.actions, part["action"].numpy())
        np.testing.assert_array_equal(episode.rewards, part["next", "reward"][:, 0].numpy())
        assert episode.terminations[-1] or episode.truncations[-1]
        start += length
    assert episode.truncations[-1] and not episode.terminations[-1]  # the one that was cut
    assert not cartpole.transitions["next", "truncated"].any()  # ours is left as it was
    card = json.loads(dataset.storage.metadata["description"])
    assert card == {**cartpole.card, "last_cut": True}
    with pytest.raises(UserError, match="refuses 'cartpole/test-v0'"):
        to_minari(cartpole, "cartpole/test-v0", make_fn)
    assert list(minari.list_local_datasets()) == ["cartpole/test-v0"]
    assert minari.namespace.list_local_namespaces() == ["cartpole"]


def test_a_failed_export_leaves_nothing(cartpole, tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))

    def fail(self, episodes):
        raise OSError("no space left")

    monkeypatch.setattr("minari.dataset._storages.hdf5_storage.HDF5Storage.update_episodes", fail)
    with pytest.raises(OSError, match="no space left"):
        to_minari(cartpole, "cartpole/test-v0", make_fn)
    assert list(tmp_path.iterdir()) == []
    assert minari.list_local_datasets() == {}


def contents(path):
    """Every array and attribute of an HDF5 file."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(path) as file:
        return {
            name: (
                dict(group.attrs),
                {key: (array.dtype.str, array[()].tolist()) for key, array in group.items()},
            )
            for name, group in file.items()
        }


def test_parts_of_bounded_size_hold_what_one_part_holds(cartpole, tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    storage = minari.dataset._storages.hdf5_storage.HDF5Storage
    write, parts = storage.update_episodes, []

    def export(part_bytes):
        folder = tmp_path / str(part_bytes) / "cartpole/test-v0"
        parts.clear()

        def watch(self, episodes):
            episodes = list(episodes)
            parts.append([(buffer.id, len(buffer)) for buffer in episodes])
            assert not folder.exists()  # Whenever it is killed, nothing has the dataset's name.
            write(self, episodes)

        monkeypatch.setattr(storage, "update_episodes", watch)
        monkeypatch.setattr("giril_rl.demos.minari.PART_BYTES", part_bytes)
        monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / str(part_bytes)))
        to_minari(cartpole, "cartpole/test-v0", make_fn)
        metadata = json.loads((folder / "data/metadata.json").read_text())
        return contents(folder / "data/main_data.hdf5"), metadata

    lengths = cartpole.lengths.tolist()
    whole, metadata = export(10**9)
    assert parts == [[], list(enumerate(lengths))]
    # 2 x 4 float32, 3 int64, a float32 and 3 flags are 63 bytes a transition.
    second = sorted(lengths)[-2]
    for most in (3, second):
        held, said = export(63 * most + 62)
        assert max(sum(length for _, length in part) for part in parts) <= most
        assert held == whole
        assert said | {"dataset_size": metadata["dataset_size"]} == metadata
    # With room for all but the longest episode, that one alone is in pieces.
    assert sum(map(len, parts)) == len(lengths) - 1 + -(-max(lengths) // second)


def test_an_environment_that_no_text_names_is_its_spaces(cartpole, tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    env_class = type(make_fn().unwrapped)
    monkeypatch.setitem(
        gymnasium.registry, "Mine-v0", gymnasium.envs.registration.EnvSpec("Mine-v0", env_class)
    )
    to_minari(cartpole, "mine/test-v0", lambda: gymnasium.make("Mine-v0"))
    dataset = minari.load_dataset("mine/test-v0")
    assert dataset.env_spec is None
    assert dataset.observation_space == env_class().observation_space
    assert dataset.total_episodes == cartpole.num_episodes


def test_nothing_is_begun_where_there_is_no_room(cartpole, tmp_path, monkeypatch):
    """HDF5 would end the process without a word."""
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    room = shutil.disk_usage(tmp_path)
    # 100 transitions of 63 bytes would fit, the arrays of 3 episodes would not.
    monkeypatch.setattr(shutil, "disk_usage", lambda place: room._replace(free=20_000))
    with pytest.raises(OSError, match="No space left"):
        to_minari(cartpole, "cartpole/test-v0", make_fn)
    assert not list(tmp_path.iterdir())


def test_missing_package_names_the_extra(cartpole, monkeypatch):
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(UserError, match=r'pip install "giril-rl\[minari\]"'):
        to_minari(cartpole, "cartpole/test-v0", make_fn)
