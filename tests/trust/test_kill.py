"""A run that is killed, wherever that is, ends as an undisturbed one, bit for bit."""

import os
import random
import shutil
import signal
import time

import pytest
from folders import assert_readable, assert_same, contents
from tiny import RECIPES, words

KILLED = -signal.SIGKILL


class Undisturbed:
    """What each recipe leaves when nothing happens, and how long it takes."""

    def __init__(self, nursery, folder):
        self.nursery, self.folder, self.known = nursery, folder, {}

    def __call__(self, recipe, **more):
        if recipe not in self.known:
            root = self.folder / recipe
            began = time.monotonic()
            ended = self.nursery.run(words(recipe, root, **more), root=str(root))
            assert ended.code == 0, ended.words
            assert_readable(root)
            self.known[recipe] = contents(root), ended.points, time.monotonic() - began
        return self.known[recipe]


@pytest.fixture(scope="module")
def undisturbed(nursery, tmp_path_factory):
    return Undisturbed(nursery, tmp_path_factory.mktemp("undisturbed"))


def live(nursery, recipe, root, more=(), **points):
    """One life of a run; whether it came to its end."""
    ended = nursery.run(words(recipe, root, **dict(more)), root=str(root), **points)
    assert ended.code in (0, KILLED), ended.words
    assert_readable(root)
    return ended.code == 0


def finish(nursery, recipe, root, expected, note, more=()):
    """Lets a run come to its end, which must be that of the undisturbed one."""
    assert live(nursery, recipe, root, more), note
    assert_same(contents(root), expected, note)


def killed_at(nursery, recipe, root, expected, point):
    """A new run that is killed at a point and then left alone."""
    assert not live(nursery, recipe, root, kill_at=point), point
    finish(nursery, recipe, root, expected, f"{recipe}, killed at point {point}")
    shutil.rmtree(root)


@pytest.mark.slow
def test_a_kill_anywhere(nursery, undisturbed, tmp_path):
    """The short form: some points of the whole chain, in one run that never gets far."""
    expected, points, _ = undisturbed("giril")
    chosen = random.Random(0).sample(range(1, points), 5)
    for point in chosen:
        live(nursery, "giril", tmp_path, kill_at=point)
    finish(nursery, "giril", tmp_path, expected, chosen)


@pytest.mark.slow
@pytest.mark.parametrize("recipe", RECIPES)
def test_a_run_that_is_killed_at_each_point_in_turn(recipe, nursery, undisturbed, tmp_path):
    """Life number n is killed at its n-th point, until one has no n-th point."""
    expected, _, _ = undisturbed(recipe)
    kills = 0
    while not live(nursery, recipe, tmp_path, kill_at=kills + 1):
        kills += 1
        assert kills < 500, "no life gets anywhere"
    assert_same(contents(tmp_path), expected, f"{recipe}, killed {kills} times")
    print(f"{recipe}: {kills} kills")
    assert kills >= 20


@pytest.mark.slow
@pytest.mark.parametrize("recipe", RECIPES)
def test_a_run_that_is_killed_once(recipe, nursery, undisturbed, tmp_path):
    """At points of the undisturbed run, each in a folder of its own."""
    expected, points, _ = undisturbed(recipe)
    chosen = random.Random(recipe).sample(range(1, points + 1), min(points, 6))
    for point in chosen:
        killed_at(nursery, recipe, tmp_path / str(point), expected, point)
    print(f"{recipe}: {len(chosen)} kills of {points} points")


@pytest.mark.slow
def test_a_run_on_a_game_that_is_killed(nursery, undisturbed, tmp_path):
    """Frames, pixel networks and games that are replayed; at points of two runs in turn."""
    pytest.importorskip("ale_py")
    undisturbed("player")
    more = {"expert.path": undisturbed.folder / "player/player"}
    expected, points, _ = undisturbed("game", **more)
    assert "game/ppo.safetensors" in expected and any("frames" in name for name in expected)
    chosen = random.Random(0).sample(range(1, points // 2), 6)
    kills = 0
    for number in range(2):
        root = tmp_path / str(number)
        lives = chosen[number::2]
        kills += sum(not live(nursery, "game", root, more, kill_at=point) for point in lives)
        finish(nursery, "game", root, expected, lives, more)
    print(f"game: {kills} kills of {points} points")
    assert kills >= 3


@pytest.mark.slow
@pytest.mark.parametrize("recipe", RECIPES)
def test_a_run_that_is_killed_at_any_time(recipe, nursery, undisturbed, tmp_path):
    """By the clock, so also where no file is touched; again and again in one folder."""
    expected, _, seconds = undisturbed(recipe)
    clock = random.Random(recipe)
    kills = 0
    for _ in range(6):
        pid = nursery.start(words(recipe, tmp_path))
        time.sleep(clock.uniform(0, seconds))
        os.kill(pid, signal.SIGKILL)
        kills += nursery.wait(pid).code == KILLED
        assert_readable(tmp_path)
    finish(nursery, recipe, tmp_path, expected, f"{recipe}, killed {kills} times by the clock")
    print(f"{recipe}: {kills} kills by the clock")


@pytest.mark.slow
def test_two_runs_at_once_do_not_disturb_each_other(nursery, undisturbed, tmp_path):
    """Of one expert and one demonstration, which both would make."""
    expected, _, _ = undisturbed("giril")
    pids = [
        nursery.start(words("giril", tmp_path, out=tmp_path / name)) for name in ("giril", "other")
    ]
    for pid in pids:
        ended = nursery.wait(pid)
        assert ended.code == 0, ended.words
    found = contents(tmp_path)
    other = {name: value for name, value in found.items() if name.startswith("other/")}
    one = {name: value for name, value in found.items() if name not in other}
    assert_same(one, expected)
    own = {name: value for name, value in expected.items() if name.startswith("giril/")}
    assert_same({name.replace("other/", "giril/", 1): v for name, v in other.items()}, own)
