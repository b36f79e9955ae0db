"""The reward along a game as it is drawn."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Categorical

from giril_rl.experiments.report.game import Game
from giril_rl.experiments.report.game_reward import draw_game, rewards_of
from giril_rl.rewards import GenerativeReward

STEPS = 300


@pytest.fixture(scope="module")
def game():
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


def test_rewards_are_those_of_all_transitions_at_once(game):
    reward = GenerativeReward.for_pixels(Categorical(3)).eval()
    with torch.no_grad():
        whole = reward(game.transitions.clone())["next", "intrinsic_reward"].flatten().numpy()
    assert np.allclose(rewards_of(reward, game.transitions), whole, rtol=1e-6)
    assert list(game.transitions["next"].keys()) == ["observation"]  # It is left as it was.


def test_the_picture_has_reward_score_and_lives(game, monkeypatch, tmp_path):
    from matplotlib.figure import Figure

    figures, savefig = [], Figure.savefig
    monkeypatch.setattr(
        Figure, "savefig", lambda self, *a, **k: (savefig(self, *a, **k), figures.append(self))
    )
    rewards = np.arange(STEPS, dtype=np.float32)
    draw_game(rewards, game, "a title", tmp_path / "picture.png", demonstration=50.0)
    assert (tmp_path / "picture.png").read_bytes().startswith(b"\x89PNG")
    upper, detail, score, lives = figures[0].axes
    labels = [text.get_text() for text in upper.get_legend().get_texts()]
    assert labels == ["reward of a step", "mean over the demonstration", "a life is lost"]
    assert np.array_equal(upper.lines[0].get_ydata(), rewards)
    left_out = np.flatnonzero(np.isnan(detail.lines[0].get_ydata()))
    assert left_out.tolist() == [0, 1, 2, 100, 101, 102]
    for axes in (upper, detail, score):
        places = [line.get_xdata()[0] for line in axes.lines if line.get_linestyle() == ":"]
        assert places == game.lost.tolist() == [100, 300]
    drawn = next(line for line in score.lines if len(line.get_xdata()) > 2)
    assert drawn.get_ydata().tolist() == [0.0, *game.score]
    assert lives.lines[0].get_ydata().tolist() == [2, *game.lives]
    assert score.get_ylim()[0] < -5 and lives.get_ylim()[1] > 2
