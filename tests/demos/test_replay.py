import gymnasium
import pytest
from counter import Counter

from giril_rl.demos import (
    Demonstration,
    check_demonstration,
    record_demonstration,
    verify_by_replay,
)
from giril_rl.errors import UserError


@pytest.mark.parametrize("shift", [1, -1])
def test_actions_one_step_off_pass_the_check_but_not_the_replay(demo, make_fn, shift):
    data = demo.transitions.clone()
    data["action"] = data["action"].roll(shift, 0)
    shifted = Demonstration(data, demo.card)
    check_demonstration(shifted)
    with pytest.raises(UserError, match=r"elsewhere at index 0 .*not aligned"):
        verify_by_replay(shifted, make_fn)


def test_one_wrong_action_is_found_where_it_is(demo, make_fn):
    data = demo.transitions.clone()
    data["action"][8] += 1e-3
    changed = Demonstration(data, demo.card)
    with pytest.raises(UserError, match=r"at index 8 \(next observation off by 0\.001"):
        verify_by_replay(changed, make_fn)
    verify_by_replay(changed, make_fn, tolerance=2e-3)


def test_wrong_reward_and_end_are_found(demo, make_fn):
    data = demo.transitions.clone()
    data["next", "reward"][3] = 2.0
    with pytest.raises(UserError, match=r"index 3 \(next reward off by 1"):
        verify_by_replay(Demonstration(data, demo.card), make_fn)
    with pytest.raises(UserError, match=r"index 4 \(next terminated"):
        verify_by_replay(demo, lambda: Counter(horizon=6))


def test_an_integer_that_is_no_action_is_not_played():
    def make_fn():
        return gymnasium.make("CartPole-v1")

    demo = record_demonstration(make_fn, lambda o: o.new_ones(1).long(), episodes=1, seed=0)
    demo.transitions["action"][3] = 2
    with pytest.raises(UserError, match=r"has the action 2 at index 3, and .* none but 0 to 1"):
        verify_by_replay(demo, make_fn)


def test_seeds_must_fit(demo, make_fn):
    with pytest.raises(UserError, match="0 seeds for 3 episodes"):
        verify_by_replay(Demonstration(demo.transitions, {}), make_fn)
    swapped = {**demo.card, "seeds": demo.card["seeds"][::-1]}
    with pytest.raises(UserError, match="another first observation at index 0"):
        verify_by_replay(Demonstration(demo.transitions, swapped), make_fn)
