"""What a player does with made-up keys, recorded without a screen."""

import sys
import types
from pathlib import Path

import numpy as np
import pytest
from counter import Counter
from pixels import Pixels

from giril_rl.cli.command_line import main
from giril_rl.demos import Demonstration, verify_by_replay
from giril_rl.demos.play import KEYS, Window, action_of, play_demonstration
from giril_rl.errors import UserError

PONG = ["NOOP", "FIRE", "RIGHT", "LEFT", "RIGHTFIRE", "LEFTFIRE"]
EIGHT = ["NOOP", "FIRE", "UP", "RIGHT", "LEFT", "DOWN", "UPRIGHT", "UPFIRE", "UPRIGHTFIRE"]


class Keys:
    """A screen whose keys are written down beforehand; then nobody presses anything."""

    def __init__(self, *pressed):
        self.pressed = list(pressed)
        self.frames = []
        self.closed = 0

    def show(self, frame):
        self.frames.append(frame.copy())
        held = self.pressed.pop(0) if self.pressed else ""
        return None if held is None else frozenset(held.split())

    def close(self):
        self.closed += 1


@pytest.mark.parametrize(
    ("keys", "meanings", "name"),
    [
        ("", PONG, "NOOP"),
        ("right fire", PONG, "RIGHTFIRE"),
        ("left right", PONG, "NOOP"),
        ("left right fire", PONG, "FIRE"),
        ("up", PONG, "NOOP"),
        ("up left fire", PONG, "LEFTFIRE"),
        ("up right", EIGHT, "UPRIGHT"),
        ("up right fire", EIGHT, "UPRIGHTFIRE"),
        ("down left", EIGHT, "LEFT"),
        ("down fire", EIGHT, "DOWN"),
        ("up down right", EIGHT, "RIGHT"),
    ],
)
def test_keys_ask_for_an_action(keys, meanings, name):
    assert meanings[action_of(frozenset(keys.split()), meanings)] == name


def test_what_is_pressed_is_recorded_beside_the_frame_it_answers():
    screen = Keys("left", "right", "", "right", "left", "left")
    demo = play_demonstration(Pixels, screen, episodes=2, seed=3, task="pixels", lives="first")
    data = demo.transitions
    assert data["action"].tolist() == [1, 2, 0, 2, 1, 1]
    assert data["episode"].tolist() == [0, 0, 0, 1, 1, 1]
    np.testing.assert_array_equal(np.stack(screen.frames), data["observation"][:, -1].numpy())
    verify_by_replay(demo, Pixels)
    assert (demo.card["deterministic"], demo.card["lives"], screen.closed) == (
        "by hand",
        "first",
        1,
    )
    assert demo.card["actions"] == ["NOOP", "LEFT", "RIGHT"]


def test_a_closed_window_keeps_nothing():
    screen = Keys("left", "left", "left", "left", None)
    with pytest.raises(UserError, match="closed before all episodes were over: none is kept"):
        play_demonstration(Pixels, screen, episodes=2, seed=3)
    assert screen.closed == 1


def test_a_game_that_does_not_name_its_actions_is_refused():
    screen = Keys()
    with pytest.raises(UserError, match=r"Counter does not name its actions .* by hand"):
        play_demonstration(Counter, screen, episodes=1, seed=0)
    assert screen.frames == []


def refused(capsys, *words):
    assert main(["demo", "play", *words, "--out", "demo"]) == 2
    captured = capsys.readouterr()
    (line,) = captured.err.splitlines()
    assert captured.out == "" and list(Path().iterdir()) == []
    return line


def test_without_pygame_or_a_screen_one_sentence_says_so(tmp_path, monkeypatch, capsys):
    pytest.importorskip("ale_py")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "pygame", None)
    assert 'pip install "giril-rl[play]"' in refused(capsys, "--task", "breakout")
    monkeypatch.setitem(sys.modules, "pygame", types.ModuleType("pygame"))
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    assert "there is no display here" in refused(capsys, "--task", "breakout")
    assert "shows no images" in refused(capsys, "--env-id", "CartPole-v1")
    assert "--episodes 0: at least 1" in refused(capsys, "--task", "breakout", "--episodes", "0")
    assert "--seed -1: at least 0" in refused(capsys, "--task", "breakout", "--seed", "-1")
    assert "either --task NAME or --env-id ID" in refused(capsys)


def test_the_command_saves_what_was_played(tmp_path, monkeypatch, capsys):
    pytest.importorskip("ale_py")
    monkeypatch.chdir(tmp_path)
    screen = Keys("right", "right fire")
    monkeypatch.setattr("giril_rl.demos.play.Window", lambda title: screen)
    assert main(["demo", "play", "--task", "breakout", "--out", "mine"]) == 0
    demo = Demonstration.load("mine")
    assert demo.transitions["action"][:3].tolist() == [2, 2, 0]  # Breakout has no RIGHTFIRE.
    assert f"mine has {len(demo)} transitions" in capsys.readouterr().out
    assert main(["demo", "show", "mine"]) == 0
    assert "by hand, seed 0" in capsys.readouterr().out


def test_a_window_without_a_screen(monkeypatch):
    """Where pygame is installed: its dummy driver draws into nothing and has no keys."""
    pytest.importorskip("pygame")
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    window = Window("game")
    frame = np.zeros((84, 84), np.uint8)
    frame[10, 20] = 200  # The row first.
    assert window.show(frame) == frozenset() and set(window._codes) == set(KEYS)
    colour = window._window.get_at((20 * 6 + 3, 10 * 6 + 3))
    assert tuple(colour)[:3] == (200, 200, 200)
    game = window._game
    game.event.post(game.event.Event(game.QUIT))
    assert window.show(frame) is None
    window.close()
