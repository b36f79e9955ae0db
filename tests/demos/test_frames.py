import pickle
import zipfile

import numpy as np
import pytest
import torch
from pixels import Pixels, steer
from wrong import Evil

from giril_rl.demos import Demonstration, record_demonstration, verify_by_replay
from giril_rl.demos.storage import load_frames, save_frames
from giril_rl.errors import UserError
from giril_rl.files.disk import read_json, write_json


@pytest.fixture
def recorded():
    return record_demonstration(Pixels, steer, episodes=2, seed=0, lives="first")


@pytest.fixture
def folder(recorded, tmp_path):
    recorded.save(tmp_path / "demo")
    return tmp_path / "demo"


def parts(folder):
    with np.load(folder / "frames.npz", allow_pickle=False) as archive:
        return dict(archive)


def test_round_trip_is_exact(recorded, folder, tmp_path):
    loaded = Demonstration.load(folder)
    assert (loaded.transitions == recorded.transitions).all()
    assert loaded.transitions["next", "observation"].dtype == torch.uint8
    card = dict(loaded.card)
    assert (card.pop("format_version"), card.pop("frames")["shape"]) == (2, [3, 5, 4])
    assert card == recorded.card
    verify_by_replay(loaded, Pixels)
    loaded.save(tmp_path / "copy")
    assert (Demonstration.load(tmp_path / "copy").transitions == recorded.transitions).all()


def test_each_distinct_frame_is_stored_once(recorded, folder):
    data = recorded.transitions
    images = torch.cat([data["observation"], data["next", "observation"]]).flatten(0, 1)
    distinct = len(images.flatten(1).unique(dim=0))
    held = parts(folder)
    assert held["planes"].shape == (distinct, 5, 4)
    assert distinct <= len(recorded) + recorded.num_episodes + 1  # And the black one.
    assert read_json(folder / "card.json")["frames"]["planes"] == distinct
    assert not (folder / "transitions" / "observation.memmap").exists()
    # The second plane is what changed since the first, which is black.
    assert not held["planes"][0].any()
    assert torch.from_numpy(held["planes"][1]).equal(data["observation"][0, -1])


def test_a_changed_pixel_is_a_plane_of_its_own(tmp_path):
    images = torch.randint(0, 256, (7, 4, 6, 5), dtype=torch.uint8)
    declared = save_frames(tmp_path / "frames.npz", images, images.flip(0))
    assert declared == {"planes": 28, "shape": [4, 6, 5]}
    before, after = load_frames(tmp_path / "frames.npz", declared, length=7)
    assert before.equal(images) and after.equal(images.flip(0))


def rewrite(folder, **changed):
    np.savez_compressed(folder / "frames.npz", **{**parts(folder), **changed})


def test_sizes_are_looked_at_before_use(folder, monkeypatch):
    held = parts(folder)
    rewrite(folder, planes=np.zeros((1000, 5, 4), dtype=np.uint8))
    monkeypatch.setattr(np, "load", lambda *_, **__: pytest.fail("was decompressed"))
    with pytest.raises(UserError, match=r"has planes of uint8 \[1000, 5, 4\] instead of uint8"):
        Demonstration.load(folder)
    np.savez_compressed(
        folder / "frames.npz", **{**held, "observation": held["observation"].astype(np.int64)}
    )
    with pytest.raises(UserError, match=r"has observation of int64 \[6, 3\] instead of int32"):
        Demonstration.load(folder)
    np.savez_compressed(folder / "frames.npz", **held, extra=held["planes"])
    with pytest.raises(UserError, match=r"holds extra\.npy, .* instead of planes, observation"):
        Demonstration.load(folder)


def test_a_header_that_promises_more_than_there_is_is_refused(folder):
    held = parts(folder)
    with zipfile.ZipFile(folder / "frames.npz", "w") as archive:
        for name, array in held.items():
            with archive.open(f"{name}.npy", "w") as file:
                np.lib.format.write_array(file, array if name != "planes" else array[:1])
    card = read_json(folder / "card.json")
    write_json(folder / "card.json", {**card, "frames": {"planes": 10**12, "shape": [3, 5, 4]}})
    with pytest.raises(UserError, match=r"has planes of uint8 \[1, 5, 4\] instead of uint8"):
        Demonstration.load(folder)


@pytest.mark.parametrize("index", [-1, 10**6])
def test_an_index_beyond_the_planes_is_refused(folder, index):
    changed = parts(folder)["next_observation"]
    changed[0, 0] = index
    rewrite(folder, next_observation=changed)
    with pytest.raises(UserError, match="refers to planes that are not among its"):
        Demonstration.load(folder)


@pytest.mark.parametrize(
    "declared",
    [
        None,
        {},
        {"planes": 9},
        {"planes": True, "shape": [3, 5, 4]},
        {"planes": 9, "shape": "3"},
        {"planes": 9, "shape": [3, -5, 4]},
        {"planes": 9, "shape": [60]},
    ],
    ids=str,
)
def test_a_card_must_declare_the_frames(folder, declared):
    write_json(folder / "card.json", {**read_json(folder / "card.json"), "frames": declared})
    with pytest.raises(UserError, match=r"does not say what frames\.npz holds"):
        Demonstration.load(folder)


def test_pickle_in_the_archive_is_never_loaded(folder, tmp_path):
    mark = tmp_path / "exploded"
    planes = np.array([Evil(mark)], dtype=object)
    np.savez_compressed(folder / "frames.npz", **{**parts(folder), "planes": planes})
    with pytest.raises(UserError, match=r"has planes of object \[1\]"):
        Demonstration.load(folder)
    (folder / "frames.npz").write_bytes(pickle.dumps(Evil(mark)))
    with pytest.raises(UserError, match=r"frames\.npz is damaged"):
        Demonstration.load(folder)
    assert not mark.exists()


def test_damage_is_named(folder):
    path = folder / "frames.npz"
    whole = path.read_bytes()
    middle = len(whole) // 4
    for broken in (whole[:-30], whole[:middle] + b"\x00" * 9 + whole[middle + 9 :], b""):
        path.write_bytes(broken)
        with pytest.raises(UserError, match=r"frames\.npz (is damaged|has planes)"):
            Demonstration.load(folder)
    path.unlink()
    with pytest.raises(UserError, match=r"format 2 and no frames\.npz"):
        Demonstration.load(folder)


def test_vectors_are_written_as_before(demo, tmp_path):
    demo.save(tmp_path / "vectors")
    assert sorted(path.name for path in (tmp_path / "vectors").iterdir()) == [
        "card.json",
        "transitions",
    ]
    assert read_json(tmp_path / "vectors" / "card.json")["format_version"] == 1
