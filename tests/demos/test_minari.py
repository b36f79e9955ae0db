import json
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


def test_missing_package_names_the_extra(cartpole, monkeypatch):
    monkeypatch.setitem(sys.modules, "minari", None)
    with pytest.raises(UserError, match=r'pip install "giril-rl\[minari\]"'):
        to_minari(cartpole, "cartpole/test-v0", make_fn)
