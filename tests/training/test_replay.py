"""The replay buffer: what it holds, what it draws, and that a killed run finds it as it was."""

import pytest
import torch
from tensordict import TensorDict

from giril_rl.errors import UserError
from giril_rl.training.replay import Replay


def numbered(first, count):
    """Transitions that tell their own number."""
    x = torch.arange(first, first + count, dtype=torch.float32).unsqueeze(-1)
    return TensorDict({"x": x, "next": {"x": x + 1, "reward": -x}}, [count])


KEYS = ["x", ("next", "x")]


def drawn(replay, count=4000):
    return set(replay.sample(count)["x"].flatten().tolist())


@pytest.mark.parametrize("on_disk", [True, False])
def test_it_holds_the_latest_transitions_and_draws_each_of_them(on_disk, tmp_path):
    replay = Replay(KEYS, size=20, slack=7, folder=tmp_path / "r" if on_disk else None)
    for first in range(0, 60, 6):
        replay.extend(numbered(first, 6))
    assert len(replay) == 20
    sample = replay.sample(4000)
    assert set(sample["x"].flatten().tolist()) == set(range(40, 60))
    assert torch.equal(sample["next", "x"], sample["x"] + 1)  # Rows stay together.
    assert ("next", "reward") not in sample.keys(True)
    counts = torch.bincount(sample["x"].flatten().long() - 40)
    assert (counts - 200).abs().max() < 5 * 200**0.5


def test_the_files_are_no_larger_than_the_buffer(tmp_path):
    replay = Replay(KEYS, size=20, slack=7, folder=tmp_path)
    for first in range(0, 600, 6):
        replay.extend(numbered(first, 6))
    assert {p.name: p.stat().st_size for p in tmp_path.iterdir()} == {
        "x.memmap": 27 * 4,
        "next.x.memmap": 27 * 4,
    }


def test_a_change_to_the_batch_afterwards_is_not_seen():
    replay, batch = Replay(KEYS, size=10), numbered(0, 5)
    replay.extend(batch)
    batch["x"].fill_(99)
    assert drawn(replay) == set(range(5))


def test_a_killed_run_finds_the_transitions_of_its_checkpoint(tmp_path):
    """Though more were written since, all around the ring."""
    replay = Replay(KEYS, size=20, slack=12, folder=tmp_path)
    for first in range(0, 48, 6):
        replay.extend(numbered(first, 6))
    state = replay.state_dict()
    replay.extend(numbered(1000, 6))  # Lost with the process: the slack is not used up yet.

    again = Replay(KEYS, size=20, slack=12, folder=tmp_path)
    again.load_state_dict(state)
    again.extend(numbered(48, 6))
    assert drawn(again) == set(range(34, 54))


def test_checksums_cover_what_may_still_be_drawn(tmp_path):
    replay = Replay(KEYS, size=20, slack=12, folder=tmp_path)
    for first in range(0, 60, 6):
        replay.extend(numbered(first, 6))
        state = replay.state_dict()
    assert [part[:2] for part in state["sums"]] == [[36, 42], [42, 48], [48, 54], [54, 60]]


@pytest.mark.parametrize("fault", ["changed", "short", "missing", "link"])
def test_files_that_are_not_the_checkpoints_are_refused(fault, tmp_path):
    replay = Replay(KEYS, size=20, folder=tmp_path / "r")
    replay.extend(numbered(0, 12))
    state, path = replay.state_dict(), tmp_path / "r/x.memmap"
    content = bytearray(path.read_bytes())
    if fault == "changed":
        content[17] ^= 1
    path.unlink()
    if fault == "link":
        (tmp_path / "elsewhere").write_bytes(content)
        path.symlink_to(tmp_path / "elsewhere")
    elif fault != "missing":
        path.write_bytes(content[:-4] if fault == "short" else content)
    again = Replay(KEYS, size=20, folder=tmp_path / "r")
    with pytest.raises(UserError, match="is not that of the checkpoint"):
        again.load_state_dict(state)


def test_a_buffer_in_memory_cannot_be_continued():
    replay = Replay(KEYS, size=20)
    replay.extend(numbered(0, 3))
    with pytest.raises(ValueError, match="in memory"):
        Replay(KEYS, size=20).load_state_dict(replay.state_dict())


def test_the_demonstration_is_drawn_as_often_as_any_other_transition():
    replay = Replay(KEYS, size=30, demonstration=numbered(1000, 10))
    for first in range(0, 90, 6):
        replay.extend(numbered(first, 6))
    x = replay.sample(40_000)["x"].flatten()
    assert set(x[x >= 1000].tolist()) == set(range(1000, 1010))  # Never overwritten.
    assert (x >= 1000).float().mean().item() == pytest.approx(0.25, abs=0.02)


def test_half_of_each_minibatch_is_demonstrated():
    replay = Replay(KEYS, size=30, demonstration=numbered(1000, 10), share=0.5)
    replay.extend(numbered(0, 30))
    for part in replay.sample(64, minibatch=8)["x"].flatten().split(8):
        assert (part >= 1000).sum() == 4


def test_sampling_follows_torchs_generator():
    replay = Replay(KEYS, size=30, demonstration=numbered(1000, 10))
    replay.extend(numbered(0, 30))
    torch.manual_seed(3)
    first = replay.sample(20)
    torch.manual_seed(3)
    assert (replay.sample(20) == first).all()
