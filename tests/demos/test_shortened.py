"""The first episodes and the first transitions of a demonstration."""

import pytest
import torch

from giril_rl.demos import Demonstration, holdout, shortened, subsample
from giril_rl.demos.check import check_whole_episode
from giril_rl.errors import UserError


def test_nothing_chosen_is_the_demonstration_itself(demo):
    assert shortened(demo) is demo


def test_whole_episodes_leave_the_cut_one_out(demo):
    part = shortened(demo, episodes=2)
    assert part.lengths.tolist() == [5, 5] and part.card["length"] is None
    assert (part.transitions == demo.transitions[:10]).all()
    assert len(part.card["seeds"]) == len(part.card["episode_returns"]) == 2
    assert part.card["transitions"] == 10 and demo.card["transitions"] == 12
    part.check()


@pytest.mark.parametrize("first", [2, 5, 7, 12])
def test_the_first_transitions(demo, first, tmp_path):
    part = shortened(demo, first=first)
    assert (part.transitions == demo.transitions[:first]).all() and len(part) == first
    assert part.card["length"] == first
    # The score is that of the whole episodes, not of the beginning of one.
    assert part.mean_return() == demo.mean_return() == 5.0
    part.save(tmp_path / "part")
    assert Demonstration.load(tmp_path / "part").demo_id == part.demo_id


def test_of_the_first_episodes_the_first_transitions(demo):
    part = shortened(demo, episodes=1, first=3)
    assert part.lengths.tolist() == [3]
    assert part.card["taken_from"] == {"transitions": 12, "return_mean": 5.0}
    with pytest.raises(UserError, match=r"first=6: .* has 5 transitions in 1 episodes: give at"):
        shortened(demo, episodes=1, first=6)


def test_1_in_k_and_the_pairs_for_validation_are_of_the_used_part(demo):
    part = shortened(demo, first=7)
    steps = demo.transitions["observation"]
    assert torch.equal(subsample(part, 3)["observation"], steps[[0, 3, 6]])
    assert torch.equal(holdout(part, 3)["observation"], steps[[1, 2, 4, 5]])


def test_what_is_taken_is_a_copy(demo):
    before = demo.transitions.clone()
    shortened(demo, first=4).transitions["observation"].zero_()
    assert (demo.transitions == before).all()


def test_more_than_there_is_is_refused(demo, whole):
    with pytest.raises(UserError, match=r"^demo\.first=13: the demonstration has 12 transitions: "):
        shortened(demo, first=13)
    for of in (demo, whole):  # The third episode of the first one is cut.
        with pytest.raises(UserError, match=r"^demo\.episodes=3: .* has 2 whole episodes: give"):
            shortened(of, episodes=3)


def test_unknown_rewards_have_no_mean(demo):
    unknown = Demonstration(demo.transitions, {**demo.card, "rewards": False})
    assert shortened(unknown, first=4).card["taken_from"]["return_mean"] is None


def test_a_card_that_was_made_up_is_no_score(demo):
    for taken in (3, {}, {"return_mean": "much"}, {"return_mean": float("nan")}):
        made_up = Demonstration(demo.transitions, {**demo.card, "taken_from": taken})
        assert made_up.mean_return() == 5.0


def test_a_beginning_has_no_whole_episode(demo):
    check_whole_episode(shortened(demo, first=5), "a return")
    with pytest.raises(UserError, match=r"has no whole episode and a return needs one: its 4 tr"):
        check_whole_episode(shortened(demo, first=4), "a return")
