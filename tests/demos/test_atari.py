"""Demonstrations of Atari games: one life or whole games."""

import itertools
import json

import numpy as np
import pytest
import torch

from giril_rl.config.schema import TaskConfig
from giril_rl.demos import Demonstration, record_demonstration, to_minari, verify_by_replay
from giril_rl.demos.record import episode_seed
from giril_rl.demos.show import describe
from giril_rl.envs import gym_factory
from giril_rl.envs.atari_preprocessing import AtariGame

pytest.importorskip("ale_py")

ACTIONS = {"Breakout": 4, "SpaceInvaders": 6, "Qbert": 6}


def task(game, episode):
    return TaskConfig(name=game, env_id=f"ALE/{game}-v5", episode=episode)


def record(game, lives="first", **amount):
    def play(observation):
        assert (observation.dtype, observation.shape) == (torch.uint8, (1, 4, 84, 84))
        return torch.randint(ACTIONS[game], (1,))

    make_fn = gym_factory(task(game, "life" if lives == "first" else "game"))
    return record_demonstration(make_fn, play, seed=0, task=game, lives=lives, **amount)


@pytest.fixture(scope="module")
def breakout():
    return record("Breakout", episodes=2)


def test_an_episode_is_what_a_plain_game_shows_up_to_its_first_lost_life(breakout):
    data, start = breakout.transitions, 0
    assert breakout.card["actions"] == ["NOOP", "FIRE", "RIGHT", "LEFT"]
    for seed, length in zip(breakout.card["seeds"], breakout.lengths.tolist(), strict=True):
        part = data[start : start + length]
        game = AtariGame("breakout")
        _, lives = game.reset(int(np.random.SeedSequence([seed, 0, 0]).generate_state(1)[0]))
        frames = [np.zeros((84, 84), np.uint8)] * 3
        shown = [game.play(action) for action in (1, 2)][-1]
        assert lives == shown.lives == 5
        frames.append(shown.frame)
        for action, reward in zip(part["action"], part["next", "reward"], strict=True):
            assert shown.lives == 5  # The life is lost in the last transition.
            shown = game.play(int(action))
            frames.append(shown.frame)
            assert shown.reward == reward
        assert shown.lives == 4 and not shown.over
        stacks = np.stack([frames[i : i + 4] for i in range(length + 1)])
        assert np.array_equal(part["observation"].numpy(), stacks[:-1])
        assert np.array_equal(part["next", "observation"].numpy(), stacks[1:])
        ends = part["next", "terminated"][:, 0]
        assert ends[-1] and ends.sum() == 1 and not part["next", "truncated"].any()
        start += length
    assert len(set(breakout.card["seeds"])) == 2


def test_whole_games_go_through_all_lives():
    make_fn = gym_factory(task("Breakout", "game"))
    demo = record("Breakout", lives="all", episodes=1)
    env = make_fn()
    env.reset(seed=demo.card["seeds"][0])
    lives = [env.step(int(action))[4]["lives"] for action in demo.transitions["action"]]
    env.close()
    assert lives == sorted(lives, reverse=True) and set(lives) == {5, 4, 3, 2, 1, 0}
    assert demo.transitions["next", "terminated"][:, 0].nonzero().tolist() == [[len(demo) - 1]]
    losses = np.flatnonzero(np.diff(lives)) + 1
    cleared = demo.transitions["next", "observation"][losses[:-1], :3]
    assert not cleared.any()


@pytest.mark.parametrize("game", ["SpaceInvaders", "Qbert"])
def test_round_trip_is_exact_and_small(game, tmp_path):
    demo = record(game, length=200)
    demo.save(tmp_path / "demo")
    loaded = Demonstration.load(tmp_path / "demo")
    assert (loaded.transitions == demo.transitions).all()
    verify_by_replay(loaded, gym_factory(task(game, "life")))
    size = sum(path.stat().st_size for path in (tmp_path / "demo").rglob("*") if path.is_file())
    assert size < 100_000 < demo.transitions["observation"].nbytes


@pytest.mark.filterwarnings("ignore:.*is set to None", "ignore:.*overriding")
def test_minari_takes_the_images(breakout, tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    to_minari(breakout, "breakout/test-v0", gym_factory(task("Breakout", "life")))
    dataset = minari.load_dataset("breakout/test-v0")
    assert dataset.observation_space.shape == (4, 84, 84)
    first = next(iter(dataset.iterate_episodes()))
    length = int(breakout.lengths[0])
    assert (first.observations.dtype, len(first.observations)) == (np.uint8, length + 1)
    assert np.array_equal(first.observations[:-1], breakout.transitions["observation"][:length])
    assert np.array_equal(
        first.observations[-1], breakout.transitions["next", "observation"][length - 1]
    )
    assert json.loads(dataset.storage.metadata["description"])["lives"] == "first"


def test_the_games_of_a_policy_that_repeats_itself_are_different_ones():
    make_fn = gym_factory(task("Breakout", "life"))
    fire = record_demonstration(make_fn, lambda o: o.new_ones(1).long(), episodes=4, seed=0)
    starts = [0, *fire.lengths.cumsum(0).tolist()]
    games = [fire.transitions[a:b] for a, b in itertools.pairwise(starts)]
    for i, one in enumerate(games):
        for other in games[:i]:
            same = len(one) == len(other) and (
                (one["next", "observation"] == other["next", "observation"]).all()
            )
            assert not same
    # The next seed was taken where one repeated a game.
    assert fire.card["seeds"] != [episode_seed(0, i) for i in range(4)]


def test_lives_and_how_an_episode_ended_are_told(breakout):
    assert breakout.card["lives_left"] == [[5, 4], [5, 4]]
    table = describe(breakout).splitlines()[-3:]
    assert table[0].split() == ["episode", "length", "score", "lives", "end"]
    assert all(row.endswith("  5 -> 4  life lost") for row in table[1:])
    whole = record("Breakout", lives="all", episodes=1)
    assert describe(whole).endswith("  5 -> 0  game over")


def test_a_game_without_lives_is_over_at_its_end():
    make_fn = gym_factory(task("Pong", "life"))
    demo = record_demonstration(
        make_fn, lambda o: o.new_zeros(1).long(), episodes=1, seed=0, task="Pong", lives="first"
    )
    assert demo.card["lives_left"] == [[0, 0]]
    assert describe(demo).endswith("  0 -> 0  game over")
