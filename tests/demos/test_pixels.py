"""Images through all that a demonstration goes through."""

import pytest
import torch
from pixels import Pixels, steer

from giril_rl.demos import (
    Demonstration,
    check_demonstration,
    holdout,
    record_demonstration,
    subsample,
    verify_by_replay,
)
from giril_rl.errors import UserError


@pytest.fixture
def lives():
    return record_demonstration(Pixels, steer, episodes=3, seed=0, lives="first")


def whole_games():
    return Pixels(whole_games=True)


def edit(demo, key, value):
    data = demo.transitions.clone()
    data.set(key, value)
    return Demonstration(data, demo.card)


def test_images_stay_images(lives):
    data = lives.transitions
    assert lives.has_images
    for image in (data["observation"], data["next", "observation"]):
        assert (image.dtype, image.shape) == (torch.uint8, (9, 3, 5, 4))
    assert lives.card["lives"] == "first"
    assert lives.card["actions"] == ["NOOP", "LEFT", "RIGHT"]
    assert data["observation"][:, -1].flatten(1).argmax(1).remainder(3).equal(data["action"])


def test_an_episode_is_a_life_from_first_to_last_state(lives):
    data = lives.transitions
    assert lives.lengths.tolist() == [3, 3, 3]
    first, last = data["step"] == 0, data["step"] == 2
    assert not data["observation"][first][:, :-1].any()  # A fresh game, nothing before it.
    assert data["next", "terminated"][:, 0].equal(last)
    # All three frames are of this life: counted by their background.
    assert data["next", "observation"][last][:, :, 0].amin(-1).tolist() == [[1, 2, 3]] * 3


def test_a_whole_game_shows_the_cleared_stack_of_its_second_life():
    demo = record_demonstration(whole_games, steer, episodes=2, seed=0, lives="all")
    assert demo.lengths.tolist() == [6, 6]
    cleared = demo.transitions["next", "observation"][2]
    assert cleared.equal(demo.transitions["observation"][3])
    assert not cleared[:-1].any() and cleared[-1].any()
    with pytest.raises(UserError, match="leads elsewhere at index 2"):
        verify_by_replay(demo, Pixels)


def test_a_fixed_length_cuts_the_last_life():
    demo = record_demonstration(Pixels, steer, length=4, seed=0)
    assert demo.lengths.tolist() == [3, 1]
    assert "lives" not in demo.card


def test_faults_of_images_are_named(lives):
    images = lives.transitions["observation"]
    with pytest.raises(UserError, match=r"misaligned: next\.observation\[0\]"):
        check_demonstration(edit(lives, "observation", images.roll(1, 0)))
    with pytest.raises(UserError, match=r"torch.float32 and shape \[9, 3, 5, 4\]"):
        check_demonstration(edit(lives, "observation", images.float()))
    with pytest.raises(
        UserError,
        match=r"torch.uint8 and shape \[9, 60\]: it must be torch.uint8 \[9, c, h, w\]\.",
    ):
        check_demonstration(edit(lives, "observation", images.flatten(1)))
    with pytest.raises(UserError, match="different shapes"):
        check_demonstration(edit(lives, ("next", "observation"), images[..., :2]))


@pytest.mark.parametrize("shape", [(3, 5, 4), torch.Size([3, 5, 4]), [3, 5, 4]])
def test_the_tasks_shape_fits(lives, shape):
    check_demonstration(lives, observation_dim=shape)


@pytest.mark.parametrize("shape", [(4, 5, 4), 60, (60,), torch.Size([3, 5])])
def test_another_shape_is_refused(lives, shape):
    with pytest.raises(UserError, match=r"observations of shape \[3, 5, 4\] and the task of shape"):
        check_demonstration(lives, observation_dim=shape)


def test_a_vectors_shape_is_as_good_as_its_size(demo):
    check_demonstration(demo, observation_dim=torch.Size([2]))
    with pytest.raises(UserError, match=r"shape \[2\] and the task of shape \[4, 84, 84\]"):
        check_demonstration(demo, observation_dim=(4, 84, 84))


def test_replay_measures_grey_levels_without_wrapping(lives):
    data = lives.transitions.clone()
    data["next", "observation"][8, 0, 0, 0] += 255  # One level less.
    changed = Demonstration(data, lives.card)
    with pytest.raises(UserError, match=r"index 8 \(next observation off by 1\)"):
        verify_by_replay(changed, Pixels)
    verify_by_replay(changed, Pixels, tolerance=1)


@pytest.mark.parametrize("shift", [1, -1])
def test_actions_one_step_off_do_not_replay(lives, shift):
    with pytest.raises(UserError, match="not aligned"):
        verify_by_replay(edit(lives, "action", lives.transitions["action"].roll(shift, 0)), Pixels)


def test_subsample_and_holdout_part_images(lives):
    kept, rest = subsample(lives, every=4, offset=1), holdout(lives, every=4, offset=1)
    assert kept["observation"].equal(lives.transitions["observation"][1::4])
    assert (len(kept), len(rest), rest["observation"].dtype) == (2, 7, torch.uint8)
