"""A game as the report plays and draws it."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Categorical

from giril_rl.config.schema import TaskConfig
from giril_rl.envs import AtariEnv
from giril_rl.envs.atari_preprocessing import AtariGame
from giril_rl.experiments.report.game import Game, draw_game, play_game, rewards_of, typical_game
from giril_rl.rewards import GenerativeReward


class Random:
    def acting(self):
        return TensorDictModule(
            lambda seen: torch.randint(4, seen.shape[:1]), ["observation"], ["action"]
        )


def task(episode):
    return TaskConfig(name="breakout", env_id="ALE/Breakout-v5", episode=episode)


@pytest.fixture(scope="module")
def game():
    pytest.importorskip("ale_py")
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
    pytest.importorskip("ale_py")
    games = {seed: play_game(Random(), task("life"), seed=seed) for seed in range(20, 25)}
    scores = sorted(game.score[-1] for game in games.values())
    assert scores[0] < scores[2] < scores[4]
    found, seed = typical_game(Random(), task("life"), seed=20)
    assert seed in games and found.score[-1] == scores[2]
    assert (found.transitions == games[seed].transitions).all()


STEPS = 300


@pytest.fixture(scope="module")
def made_up():
    generator = torch.Generator().manual_seed(0)
    frames = torch.randint(1, 256, (STEPS + 1, 1, 84, 84), generator=generator).to(torch.uint8)
    stacks = frames.repeat(1, 4, 1, 1)
    for start in (0, 100):
        for empty in range(3):
            stacks[start + empty, : 3 - empty] = 0
    lives = np.repeat([2, 1, 0], [99, STEPS - 100, 1])
    after = TensorDict({"observation": stacks[1:]}, [STEPS])
    data = {"observation": stacks[:-1], "action": torch.arange(STEPS) % 3, "next": after}
    score = np.arange(STEPS) - 5.0
    return Game(TensorDict(data, [STEPS]), score, lives, 2, ["NOOP", "FIRE", "UP"], True)


def test_rewards_are_those_of_all_transitions_at_once(made_up):
    reward = GenerativeReward.for_pixels(Categorical(3)).eval()
    with torch.no_grad():
        whole = reward(made_up.transitions.clone())["next", "intrinsic_reward"].flatten().numpy()
    assert np.allclose(rewards_of(reward, made_up.transitions), whole, rtol=1e-6)
    assert list(made_up.transitions["next"].keys()) == ["observation"]  # It is left as it was.


def test_the_picture_has_reward_score_and_lives(made_up, drawn, tmp_path):
    rewards = np.arange(STEPS, dtype=np.float32)
    draw_game(rewards, made_up, "a title", tmp_path / "picture.png", demonstration=50.0)
    assert (tmp_path / "picture.png").read_bytes().startswith(b"\x89PNG")
    upper, detail, score, lives = drawn[0].axes
    labels = [text.get_text() for text in upper.get_legend().get_texts()]
    assert labels == ["reward of a step", "mean over the demonstration", "a life is lost"]
    assert np.array_equal(upper.lines[0].get_ydata(), rewards)
    left_out = np.flatnonzero(np.isnan(detail.lines[0].get_ydata()))
    assert left_out.tolist() == [0, 1, 2, 100, 101, 102]
    for axes in (upper, detail, score):
        places = [line.get_xdata()[0] for line in axes.lines if line.get_linestyle() == ":"]
        assert places == made_up.lost.tolist() == [100, 300]
    so_far = next(line for line in score.lines if len(line.get_xdata()) > 2)
    assert so_far.get_ydata().tolist() == [0.0, *made_up.score]
    assert lives.lines[0].get_ydata().tolist() == [2, *made_up.lives]
    assert score.get_ylim()[0] < -5 and lives.get_ylim()[1] > 2
