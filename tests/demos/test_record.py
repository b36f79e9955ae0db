import io
import itertools
import sys

import gymnasium
import numpy as np
import pytest
import torch
from counter import Counter
from gymnasium import spaces

from giril_rl.demos import record_demonstration
from giril_rl.demos.record import episode_seed
from giril_rl.errors import UserError


def test_transitions_are_aligned_by_hand(demo):
    data = demo.transitions
    assert data["episode"].tolist() == [0] * 5 + [1] * 5 + [2] * 2
    assert data["step"].tolist() == [0, 1, 2, 3, 4, 0, 1, 2, 3, 4, 0, 1]
    # The action at step t is t/8 + 1/16; the state moves by exactly that.
    torch.testing.assert_close(data["action"][:, 0], data["step"] / 8 + 1 / 16)
    moved = (data["next", "observation"] - data["observation"])[:, 0]
    torch.testing.assert_close(moved, data["action"][:, 0])
    assert data["next", "done"].reshape(-1).nonzero().reshape(-1).tolist() == [4, 9]
    # The terminal observation, not the next episode's first.
    assert data["next", "observation"][4, 1] == 5.0
    assert data["action"].dtype == torch.float32
    assert demo.lengths.tolist() == [5, 5, 2]
    assert demo.returns.tolist() == [5.0, 5.0, 2.0]


@pytest.mark.parametrize("amount", [{"length": 12}, {"episodes": 2}], ids=str)
def test_progress_is_shown_where_it_is_asked_for(amount, monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    def written(**asked):
        monkeypatch.setattr("sys.stderr", Terminal())
        record_demonstration(Counter, lambda o: o[:, :1], seed=0, **amount, **asked)
        return sys.stderr.getvalue()

    (total,) = amount.values()
    assert f"{total}/{total}" in written()
    monkeypatch.setattr("tqdm.std.time", itertools.count(0, 60).__next__)
    assert written(show_progress=False) == ""


def test_episodes_have_seeds_of_their_own(demo):
    starts = demo.transitions["observation"][demo.transitions["step"] == 0, 0]
    assert len(set(starts.tolist())) == 3
    assert demo.card["seeds"] == [episode_seed(0, i) for i in range(3)]
    expected = [np.random.default_rng(seed).uniform() for seed in demo.card["seeds"]]
    torch.testing.assert_close(starts, torch.tensor(expected, dtype=torch.float32))


def test_card_says_where_it_comes_from(whole):
    assert whole.card["length"] is None
    assert whole.card["transitions"] == 10
    assert whole.card["episode_returns"] == [5.0, 5.0]
    assert whole.card["versions"]["torch"] == str(torch.__version__)


def test_length_that_ends_with_an_episode_cuts_nothing():
    demo = record_demonstration(Counter, lambda o: o[:, 1:] * 0.1, length=10, seed=0)
    assert demo.num_episodes == 2
    assert demo.transitions["next", "done"][-1]


def test_box_actions_are_stored_as_executed():
    demo = record_demonstration(Counter, lambda o: o[:, 1:] * 0 + 7.0, length=3, seed=0)
    assert demo.transitions["action"].tolist() == [[1.0]] * 3


def test_discrete_actions_and_time_limits():
    def make_fn():
        env = Counter(horizon=100, action_space=spaces.Discrete(3))
        return gymnasium.wrappers.TimeLimit(env, 4)

    demo = record_demonstration(make_fn, lambda o: o[:, 1].long() % 3, episodes=2, seed=1)
    assert demo.transitions["action"].tolist() == [0, 1, 2, 0] * 2
    assert demo.transitions["action"].dtype == torch.int64
    assert demo.transitions["next", "truncated"].sum() == 2
    assert demo.transitions["next", "terminated"].sum() == 0


def test_sampled_policy_repeats_and_leaves_torch_generator_alone():
    def sample(observation):
        return torch.rand(1, 1)

    state = torch.get_rng_state()
    first = record_demonstration(Counter, sample, length=7, seed=3, deterministic=False)
    assert (torch.get_rng_state() == state).all()
    torch.rand(5)
    again = record_demonstration(Counter, sample, length=7, seed=3, deterministic=False)
    other = record_demonstration(Counter, sample, length=7, seed=4, deterministic=False)
    assert (first.transitions == again.transitions).all()
    assert (first.transitions["action"] != other.transitions["action"]).all()
    assert first.card["deterministic"] is False


@pytest.mark.parametrize(
    "amount", [{}, {"length": 3, "episodes": 1}, {"length": 0}, {"episodes": -1}], ids=str
)
def test_amount_must_be_one_positive_number(amount):
    with pytest.raises(UserError, match="exactly one"):
        record_demonstration(Counter, lambda o: o[:, :1], seed=0, **amount)


def test_bad_actions_are_refused():
    with pytest.raises(UserError, match="not finite"):
        record_demonstration(Counter, lambda o: o[:, :1] * torch.nan, length=3, seed=0)

    def discrete():
        return Counter(action_space=spaces.Discrete(2))

    with pytest.raises(UserError, match="not in Discrete"):
        record_demonstration(discrete, lambda o: torch.tensor([2]), length=3, seed=0)
    with pytest.raises(UserError, match="not one integer"):
        record_demonstration(discrete, lambda o: torch.tensor([[0, 1]]), length=3, seed=0)


def test_environment_that_never_ends_is_refused(monkeypatch):
    monkeypatch.setattr("giril_rl.demos.record._LONGEST_EPISODE", 50)
    with pytest.raises(UserError, match="did not end within 50 steps"):
        record_demonstration(lambda: Counter(horizon=1000), lambda o: o[:, :1], episodes=1, seed=0)


def test_environment_that_ignores_its_seed_is_refused():
    class Careless(Counter):
        def reset(self, *, seed=None, options=None):
            return super().reset(seed=None, options=options)

    with pytest.raises(UserError, match="gives another first observation at index 0"):
        record_demonstration(Careless, lambda o: o[:, :1], length=3, seed=0)


class Few(Counter):
    """Another beginning for each of two kinds of seed, and no other."""

    def reset(self, *, seed=None, options=None):
        return super().reset(seed=None if seed is None else seed % 2, options=options)


def test_whole_episodes_are_different_ones():
    demo = record_demonstration(Few, lambda o: o[:, 1:] * 0.1, episodes=2, seed=0)
    starts = demo.transitions["observation"][demo.transitions["step"] == 0, 0]
    assert starts[0] != starts[1]
    kinds = [seed % 2 for seed in demo.card["seeds"]]
    assert sorted(kinds) == [0, 1]
    # The first seed of each kind, and none between was kept.
    tried = [episode_seed(0, i) for i in range(20)]
    first = min(i for i, seed in enumerate(tried) if seed % 2 != tried[0] % 2)
    assert demo.card["seeds"] == [tried[0], tried[first]]


def test_more_episodes_than_there_are_are_refused_with_what_to_do():
    sentence = "demo.episodes=3: only 2 different ones were found, the last 30 repeat them"
    with pytest.raises(UserError, match=sentence):
        record_demonstration(Few, lambda o: o[:, 1:] * 0.1, episodes=3, seed=0)


def test_what_was_done_tells_episodes_apart_as_what_was_seen_does():
    def sample(observation):
        return torch.rand(1, 1)

    demo = record_demonstration(Few, sample, episodes=4, seed=0, deterministic=False)
    assert demo.card["seeds"] == [episode_seed(0, i) for i in range(4)]
    # A number of transitions is what it is.
    assert len(record_demonstration(Few, lambda o: o[:, 1:] * 0.1, length=20, seed=0)) == 20
