"""A game as the report plays it."""

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule

from giril_rl.config.schema import TaskConfig
from giril_rl.envs.atari_preprocessing import AtariGame
from giril_rl.experiments.report.game import play_game, typical_game

pytest.importorskip("ale_py")


class Random:
    def acting(self):
        return TensorDictModule(
            lambda seen: torch.randint(4, seen.shape[:1]), ["observation"], ["action"]
        )


def task(episode):
    return TaskConfig(name="breakout", env_id="ALE/Breakout-v5", episode=episode)


@pytest.fixture(scope="module")
def game():
    return play_game(Random(), task("life"), seed=0)


def test_a_game_goes_through_all_lives(game):
    assert game.whole and game.first_lives == 5 and game.lives[-1] == 0
    assert len(game.lost) == 5 and game.lost[-1] == len(game.lives) == len(game.transitions)
    assert game.actions == ["NOOP", "FIRE", "RIGHT", "LEFT"]
    again = play_game(Random(), task("life"), seed=0)
    assert (again.transitions == game.transitions).all()


def test_a_lost_life_ends_in_its_own_frames(game):
    data, lost = game.transitions, game.lost[0]
    after = data["next", "observation"]
    assert torch.equal(after[: lost - 1], data["observation"][1:lost])
    assert torch.equal(after[lost - 1, :-1], data["observation"][lost - 1, 1:])
    assert not data["observation"][lost, :-1].any()  # The next life begins with an empty stack.


def test_whole_games_are_the_same_game(game):
    other = play_game(Random(), task("game"), seed=0)
    assert np.array_equal(other.score, game.score)
    assert torch.equal(other.transitions["action"], game.transitions["action"])


def test_the_score_is_the_emulators(game):
    plain, actions = AtariGame("breakout"), game.transitions["action"].tolist()
    from giril_rl.envs import AtariEnv

    plain.reset(AtariEnv("breakout", 1, seed=0)._episode_seed(0))
    opening, score = [1, 2], []
    for number, action in enumerate(actions):
        for first in opening:
            plain.play(first)
        score.append(plain.play(action).reward)
        opening = [0, 1, 2] if number + 1 in game.lost else []
    assert np.array_equal(np.cumsum(score), game.score)


def test_a_long_game_is_cut_and_random_numbers_are_left_alone(game):
    before = torch.get_rng_state()
    cut = play_game(Random(), task("life"), seed=0, most=12)
    assert not cut.whole and len(cut.transitions) == 12
    assert (cut.transitions == game.transitions[:12]).all()
    assert torch.equal(torch.get_rng_state(), before)


def test_the_typical_game_is_the_one_of_median_score():
    games = {seed: play_game(Random(), task("life"), seed=seed) for seed in range(20, 25)}
    scores = sorted(game.score[-1] for game in games.values())
    assert scores[0] < scores[2] < scores[4]
    found, seed = typical_game(Random(), task("life"), seed=20)
    assert seed in games and found.score[-1] == scores[2]
    assert (found.transitions == games[seed].transitions).all()
