import errno
import hashlib
import json
import os
import pickle
import shutil

import pytest
import torch
from tensordict import TensorDict
from wrong import Evil

from giril_rl.demos import Demonstration, verify_by_replay
from giril_rl.errors import UserError
from giril_rl.files.disk import write_json


@pytest.fixture
def folder(demo, tmp_path):
    demo.save(tmp_path / "demo")
    return tmp_path / "demo"


def test_round_trip_is_exact_and_in_memory(demo, folder, make_fn):
    loaded = Demonstration.load(folder)
    assert (loaded.transitions == demo.transitions).all()
    assert {k: v.dtype for k, v in loaded.transitions.items(True, True)} == {
        k: v.dtype for k, v in demo.transitions.items(True, True)
    }
    assert loaded.card == {"format_version": 1, **demo.card}
    verify_by_replay(loaded, make_fn)
    # A change in memory must not reach the files.
    loaded.transitions["action"].zero_()
    assert (Demonstration.load(folder).transitions["action"] == demo.transitions["action"]).all()


def test_saved_again_after_loading(folder, tmp_path):
    Demonstration.load(folder).save(tmp_path / "copy")
    assert len(Demonstration.load(tmp_path / "copy")) == 12


def test_id_is_a_digest_of_all_tensors(demo, folder, monkeypatch):
    after = ("done", "observation", "reward", "terminated", "truncated")
    content = hashlib.sha256()
    for key in [("next", name) for name in after] + ["action", "episode", "observation", "step"]:
        array = demo.transitions[key].numpy()
        content.update(f"{key}torch.{array.dtype}{array.shape}".encode() + array.tobytes())
    assert demo.demo_id == content.hexdigest()[:12]
    assert Demonstration.load(folder).demo_id == demo.demo_id
    assert Demonstration(demo.transitions, {}).demo_id == demo.demo_id
    columns = demo.transitions["observation"].t().contiguous().t()  # The same in another layout.
    monkeypatch.setattr("giril_rl.demos.demonstration._AT_ONCE", 5)
    assert Demonstration(demo.transitions.replace(observation=columns)).demo_id == demo.demo_id
    demo.transitions["next", "reward"][-1] += 1
    assert demo.demo_id != Demonstration.load(folder).demo_id


def test_nothing_is_overwritten_or_left_half_done(demo, folder, monkeypatch):
    with pytest.raises(UserError, match="is there already"):
        demo.save(folder)

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr("giril_rl.demos.demonstration.write_json", fail)
    with pytest.raises(OSError, match="disk full"):
        demo.save(folder.parent / "other")
    assert os.listdir(folder.parent) == ["demo"]


def test_nothing_is_begun_where_there_is_no_room(demo, tmp_path, monkeypatch):
    """A disk that fills up under a memory map would end the process without a word."""
    room = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda place: room._replace(free=100))
    with pytest.raises(OSError, match="No space left") as raised:
        demo.save(tmp_path / "demo")
    assert raised.value.errno == errno.ENOSPC and "demo" in raised.value.filename
    assert not os.listdir(tmp_path)


def test_a_disk_that_does_not_tell_its_size_is_tried(demo, tmp_path, monkeypatch):
    room = shutil.disk_usage(tmp_path)
    untold = room._replace(total=0, used=0, free=0)
    monkeypatch.setattr(shutil, "disk_usage", lambda place: untold)
    demo.save(tmp_path / "demo")
    assert len(Demonstration.load(tmp_path / "demo")) == len(demo)


def test_unsound_demonstration_is_not_saved(demo, tmp_path):
    demo.transitions["action"][3] = torch.nan
    with pytest.raises(UserError, match="NaN"):
        demo.save(tmp_path / "demo")
    assert not (tmp_path / "demo").exists()


def test_pickle_is_never_loaded(demo, tmp_path):
    mark = tmp_path / "exploded"
    data = demo.transitions.clone()
    data.set_non_tensor("note", Evil(mark))
    data.memmap(tmp_path / "evil" / "transitions")
    write_json(tmp_path / "evil" / "card.json", {"format_version": 1, **demo.card})
    (sidecar,) = (tmp_path / "evil").rglob("*.pickle")
    with pytest.raises(UserError, match="'note', which is not a plain tensor"):
        Demonstration.load(tmp_path / "evil")
    assert not mark.exists()
    pickle.loads(sidecar.read_bytes())
    assert mark.exists()  # the bomb works, so the silence above means something


def test_disguised_pickle_is_never_loaded(folder, tmp_path):
    mark = tmp_path / "exploded"
    stray = folder / "transitions" / "next" / "other.pickle"
    stray.write_bytes(pickle.dumps(Evil(mark)))
    with pytest.raises(UserError, match=r"'other\.pickle', which is not a tensor"):
        Demonstration.load(folder)
    meta = folder / "transitions" / "next" / "meta.json"
    content = json.loads(meta.read_text())
    content["_type"] = "<class 'tensordict.tensorclass.NonTensorData'>"
    meta.write_text(json.dumps(content))
    with pytest.raises(UserError, match="other than a TensorDict"):
        Demonstration.load(folder)
    assert not mark.exists()


@pytest.mark.parametrize(
    "entry",
    [
        {"type": "TensorDict"},
        {"type": "NonTensorData"},
        {"device": "cpu", "shape": [12], "dtype": "torch.object", "is_nested": False},
        {"device": "cpu", "shape": [-1], "dtype": "torch.float32", "is_nested": False},
        {"device": "cpu", "shape": [12], "dtype": "torch.float32", "is_nested": True},
        "tensor",
    ],
    ids=str,
)
def test_metadata_other_than_a_plain_tensor_is_refused(folder, entry):
    meta = folder / "transitions" / "meta.json"
    content = json.loads(meta.read_text())
    meta.write_text(json.dumps({**content, "action": entry}))
    with pytest.raises(UserError, match="'action', which is not a plain tensor"):
        Demonstration.load(folder)


@pytest.mark.parametrize("key", ["../outside", "a/b", ""])
def test_key_cannot_name_a_file_elsewhere(folder, key):
    meta = folder / "transitions" / "meta.json"
    content = json.loads(meta.read_text())
    meta.write_text(json.dumps({**content, key: content["action"]}))
    with pytest.raises(UserError, match="not a plain tensor"):
        Demonstration.load(folder)


def test_damage_is_named(folder, tmp_path):
    def broken():
        copy = tmp_path / "broken"
        shutil.rmtree(copy, ignore_errors=True)
        return shutil.copytree(folder, copy)

    copy = broken()
    action = copy / "transitions" / "action.memmap"
    action.write_bytes(action.read_bytes()[:-1])
    with pytest.raises(UserError, match=r"action\.memmap has 47 bytes instead of 48"):
        Demonstration.load(copy)
    action.unlink()
    with pytest.raises(UserError, match=r"action\.memmap is missing"):
        Demonstration.load(copy)
    copy = broken()
    (copy / "transitions" / "next" / "meta.json").write_text('{"shape": [')
    with pytest.raises(UserError, match="is damaged"):
        Demonstration.load(copy)
    copy = broken()
    (copy / "transitions" / "observation.memmap").write_bytes(bytes(12 * 2 * 4))
    with pytest.raises(UserError, match="broken: the demonstration is misaligned"):
        Demonstration.load(copy)
    (copy / "card.json").write_text("{")
    with pytest.raises(UserError, match=r"card\.json cannot be read"):
        Demonstration.load(copy)
    write_json(copy / "card.json", {"format_version": 2})
    with pytest.raises(UserError, match="format 2"):
        Demonstration.load(copy)
    with pytest.raises(UserError, match=r"no card\.json"):
        Demonstration.load(tmp_path / "nowhere")


def test_extra_plain_tensors_are_kept(demo, tmp_path):
    demo.transitions["value"] = torch.arange(12.0)
    demo.save(tmp_path / "demo")
    assert Demonstration.load(tmp_path / "demo").transitions["value"].tolist() == list(range(12))


def test_returns_of_an_empty_demonstration():
    empty = Demonstration(TensorDict({"episode": torch.zeros(0, dtype=torch.int64)}, [0]))
    assert (len(empty), empty.num_episodes, empty.lengths.tolist()) == (0, 0, [])
