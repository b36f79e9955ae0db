import pytest
import torch
from tensordict import TensorDict

from giril_rl.runs.checkpoint import load_state, save_state
from giril_rl.training.episodes import EpisodeClock, EpisodeTracker


def batch(reward, done):
    shaped = {"reward": reward.unsqueeze(-1), "done": done.unsqueeze(-1)}
    return TensorDict({"next": shaped}, reward.shape)


class Loop:
    """The same in plain Python."""

    def __init__(self, num_envs):
        self.total, self.length = [0.0] * num_envs, [0] * num_envs

    def __call__(self, reward, done):
        returns, lengths = [], []
        for i in range(len(reward)):
            for r, d in zip(reward[i].tolist(), done[i].tolist(), strict=True):
                self.total[i] += r
                self.length[i] += 1
                if d:
                    returns.append(self.total[i])
                    lengths.append(self.length[i])
                    self.total[i], self.length[i] = 0.0, 0
        return returns, lengths


@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 0.97, 1.0])
@pytest.mark.parametrize(("num_envs", "time"), [(4, 25), (1, 10), (3, 1)])
def test_equals_a_plain_loop_over_many_batches(num_envs, time, share):
    generator = torch.Generator().manual_seed(0)
    tracker, loop = EpisodeTracker(num_envs), Loop(num_envs)
    for _ in range(8):
        reward = torch.randn(num_envs, time, generator=generator)
        done = torch.rand(num_envs, time, generator=generator) < share
        returns, lengths = tracker(batch(reward, done))
        expected, expected_lengths = loop(reward, done)
        assert lengths.tolist() == expected_lengths
        assert returns.tolist() == pytest.approx(expected, abs=1e-9)
        assert tracker.running_length.tolist() == loop.length
        assert tracker.running_return.tolist() == pytest.approx(loop.total, abs=1e-9)


def test_returns_are_exact_where_they_are_whole_numbers():
    tracker = EpisodeTracker(1)
    done = torch.zeros(1, 1000, dtype=torch.bool)
    done[0, -1] = True
    for _ in range(50):
        assert tracker(batch(torch.ones(1, 1000), done))[0].tolist() == [1000.0]


def test_the_batch_is_left_as_it_is():
    data = batch(torch.randn(2, 5), torch.rand(2, 5) < 0.5)
    before = data.clone()
    EpisodeTracker(2)(data)
    assert (data == before).all()


def test_state_goes_through_a_checkpoint(tmp_path):
    tracker = EpisodeTracker(2)
    tracker(batch(torch.full((2, 3), 0.1), torch.tensor([[False] * 3, [True, False, False]])))
    save_state(tmp_path / "state", dict(tracker.state_dict()))
    other = EpisodeTracker(2)
    other.load_state_dict(load_state(tmp_path / "state"))
    last = batch(torch.ones(2, 1), torch.ones(2, 1, dtype=torch.bool))
    returns, lengths = tracker(last)
    assert torch.equal(other(last)[0], returns)
    assert lengths.tolist() == [4, 3]
    assert returns.tolist() == pytest.approx([1.3, 1.2])


def test_only_scored_steps_count():
    """By hand: a failure after 2 of 4 steps, then a whole horizon across two batches."""
    tracker = EpisodeTracker(1)
    flags = torch.tensor([[False, False, False, True, False, False]])
    scored = torch.tensor([[True, True, False, False, True, True]])
    data = batch(torch.tensor([[1.0, 2.0, 4.0, float("nan"), 16.0, 32.0]]), flags)
    data["next", "scored"] = scored.unsqueeze(-1)
    returns, lengths = tracker(data)
    assert returns.tolist() == [3.0] and lengths.tolist() == [2]
    data["next", "done"] = torch.tensor([[False, True, False, False, False, False]]).unsqueeze(-1)
    data["next", "scored"][:] = True
    data["next", "reward"][0, 3] = 8.0
    returns, lengths = tracker(data)
    assert returns.tolist() == [16.0 + 32.0 + 3.0] and lengths.tolist() == [4]
    assert tracker.running_return.tolist() == [60.0] and tracker.running_length.tolist() == [4]


def test_an_episode_of_atari_is_a_whole_game():
    """By hand: lives end after steps 2 and 4, the game after step 4, and again after 1 step."""
    tracker = EpisodeTracker(1)
    done = torch.tensor([[False, True, False, True, True, False]])
    data = batch(torch.tensor([[1.0, 2.0, 4.0, 8.0, 16.0, 32.0]]), done)
    over = torch.tensor([[False, False, False, True, True, False]])
    data["next", "game_over"] = over.unsqueeze(-1)
    returns, lengths = tracker(data)
    assert returns.tolist() == [15.0, 16.0] and lengths.tolist() == [4, 1]
    returns, lengths = tracker(data)
    assert returns.tolist() == [47.0, 16.0] and lengths.tolist() == [5, 1]


# Time


def walk(num_envs, time, share, generator):
    """Random states, each of which is the last one's next, but after an end."""
    states = torch.randn(num_envs, time + 1, 2, generator=generator)
    done = torch.rand(num_envs, time, 1, generator=generator) < share
    after = torch.where(done, torch.zeros(()), states[:, 1:])
    following = {"observation": after, "done": done}
    return TensorDict({"observation": states[:, :-1], "next": following}, [num_envs, time])


@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("length", [1, 7, 40])
def test_the_clock_equals_a_plain_loop_however_time_is_cut(length, share, tmp_path):
    data = walk(3, 40, share, torch.Generator().manual_seed(0))
    expected = torch.zeros(3, 40, dtype=torch.int64)
    for index in range(3):
        for time in range(1, 40):
            ended = bool(data["next", "done"][index, time - 1])
            expected[index, time] = 0 if ended else expected[index, time - 1] + 1
    clock, found = EpisodeClock(), []
    for part in data.split(length, 1):
        found.append(clock(part))
        save_state(tmp_path / "state", clock.state_dict())
        clock = EpisodeClock()
        clock.load_state_dict(load_state(tmp_path / "state"))
    assert torch.equal(torch.cat(found, 1), expected)


def test_the_clock_begins_anew_where_an_environment_was_reset_in_between():
    generator = torch.Generator().manual_seed(0)
    clock = EpisodeClock()
    clock(walk(2, 5, 0.0, generator))
    assert clock(walk(2, 2, 0.0, generator)).tolist() == [[0, 1], [0, 1]]


def test_the_clock_goes_on_after_a_hidden_reset():
    """An episode of fixed length goes on from another observation than the failure's."""
    data = walk(1, 6, 0.0, torch.Generator().manual_seed(0))
    data["next", "following_observation"] = data["next", "observation"].clone()
    data["next", "observation"][0, 2] = 9.0
    clock = EpisodeClock()
    assert [clock(part).item() for part in data.split(1, 1)] == [0, 1, 2, 3, 4, 5]
