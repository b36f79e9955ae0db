"""What comes with the package is sound, small, of one life, and found by its task."""

import json
from pathlib import Path

import pytest

from giril_rl.cli.command_line import main
from giril_rl.config.schema import DemoConfig, ExpertConfig, RunConfig, TaskConfig
from giril_rl.demos import Demonstration, named_task, shipped_demonstrations, verify_by_replay
from giril_rl.demos.check import check_for_task
from giril_rl.demos.shipped import demonstration_folder, demonstration_name
from giril_rl.envs import as_recorded_task, gym_factory
from giril_rl.errors import UserError
from giril_rl.training import check_inputs, obtain_demonstration

PENDULUMS = ("inverted_double_pendulum", "inverted_pendulum", "inverted_pendulum_swingup")
SHIPPED = shipped_demonstrations()
each = pytest.mark.parametrize("name", SHIPPED)
game = pytest.mark.parametrize("name", [name for name in SHIPPED if name not in PENDULUMS])


@each
def test_each_is_small_and_sound_and_says_who_played_it_where(name):
    for folder in SHIPPED[name]:
        assert sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) < 2**20
        demo, task = Demonstration.load(folder), named_task(name, None)
        check_for_task(demo, task)
        assert (demo.card["task"], demo.card["env_id"]) == (name, task.env_id)
        assert demo.card["seed"] == demo.card["expert"]["seed"] == int(folder.name)
        assert demo.card["versions"]["torch"]


@pytest.mark.parametrize("name", PENDULUMS)
def test_a_pendulums_are_a_thousand_steps_of_five_players(name):
    demos = [Demonstration.load(folder) for folder in SHIPPED[name]]
    assert [len(demo) for demo in demos] == [1000] * 5
    assert len({demo.demo_id for demo in demos}) == 5
    for demo in demos:
        assert demo.card["processor"] and demo.card["expert"]["env_steps"] > 0
        assert demo.returns.sum() > 0.9 * demo.card["expert"]["return_mean"]


@game
def test_one_life_of_the_task_from_its_first_state_on(name):
    (folder,) = SHIPPED[name]
    demo, task = Demonstration.load(folder), named_task(name, None)
    assert demo.card["lives"] == "first"
    end = demo.transitions["next"][-1]
    assert demo.num_episodes == 1 and end["terminated"].item() and not end["truncated"].item()
    assert demo.transitions["step"][0] == 0
    # Played again from its seed it is the same bits, and no other life's.
    verify_by_replay(demo, gym_factory(as_recorded_task(task, "first")))


@each
def test_a_recipe_finds_it_by_its_task(name, tmp_path):
    env_id = named_task(name, None).env_id
    for task in (named_task(name, None), TaskConfig(name=env_id, env_id=env_id)):
        cfg, demo = (
            RunConfig(task=task, root=str(tmp_path), seed=1, steps=2000),
            DemoConfig(path="shipped"),
        )
        check_inputs(cfg, ExpertConfig(), demo)
        found, expert = obtain_demonstration(cfg, ExpertConfig(), demo)
        own = SHIPPED[name][1 % len(SHIPPED[name])]
        assert found.demo_id == Demonstration.load(own).demo_id
        assert expert == {"return_mean": found.card["expert"]["return_mean"]}
    assert not any(tmp_path.iterdir())


def test_all_six_games_have_one_and_each_pendulum_five():
    games = {"space_invaders", "beam_rider", "breakout", "qbert", "seaquest", "kung_fu_master"}
    counts = {name: len(folders) for name, folders in SHIPPED.items()}
    assert counts == dict.fromkeys(games, 1) | dict.fromkeys(PENDULUMS, 5)


def test_the_runs_seed_chooses_and_they_are_taken_in_turn():
    task = named_task("inverted_pendulum", None)
    chosen = [demonstration_folder("shipped", task, seed).name for seed in (0, 4, 5, 12)]
    assert chosen == ["0", "4", "0", "2"]
    assert demonstration_folder("shipped:inverted_pendulum", None, 7).name == "2"
    assert demonstration_folder("shipped:inverted_pendulum/3", None, 7).name == "3"
    assert demonstration_name("shipped", task, 12) == "shipped:inverted_pendulum/2"
    with pytest.raises(UserError, match=r"no such demonstration of inverted_pendulum: choose 0 to"):
        demonstration_folder("shipped:inverted_pendulum/5")


def test_a_task_goes_before_another_set_of_its_environment(tmp_path, monkeypatch):
    for name in ("walker", "walker-novice"):
        (tmp_path / name / "0").mkdir(parents=True)
        (tmp_path / name / "0" / "card.json").write_text('{"env_id": "Walker-v0"}')
    monkeypatch.setattr("giril_rl.demos.shipped._FOLDER", tmp_path)
    task = TaskConfig(name="mine", env_id="Walker-v0")
    assert demonstration_name("shipped", task) == "shipped:walker/0"
    assert demonstration_name("shipped:walker-novice", task) == "shipped:walker-novice/0"


def test_there_is_no_other_one():
    pong = TaskConfig(name="pong", env_id="ALE/Pong-v5")
    with pytest.raises(UserError, match="pong is shipped: there are beam_rider, breakout, inv"):
        demonstration_folder("shipped", pong)
    with pytest.raises(UserError, match="did you mean 'breakout'"):
        demonstration_folder("shipped:breakou")
    assert demonstration_folder("shipped_by_me", pong) == Path("shipped_by_me")


def test_another_game_is_refused_though_all_look_alike(tmp_path):
    cfg = RunConfig(task=named_task("space_invaders", None), root=str(tmp_path))
    sentence = "is of ALE/Breakout-v5 and not of ALE/SpaceInvaders-v5: use one of this task"
    with pytest.raises(UserError, match=sentence):
        check_inputs(cfg, ExpertConfig(), DemoConfig(path="shipped:breakout"))
    # Another version is no other game, and a card that does not say so is believed.
    demo = Demonstration.load(SHIPPED["space_invaders"][0])
    for number, env_id in enumerate(["ALE/SpaceInvaders-v4", None, 3]):
        place = tmp_path / str(number)
        Demonstration(demo.transitions, {**demo.card, "env_id": env_id}).save(place)
        check_inputs(cfg, ExpertConfig(), DemoConfig(path=str(place)))


def test_the_card_of_a_given_demonstration_may_lie(tmp_path):
    """It was downloaded: no number but a score is taken for one."""
    demo = Demonstration.load(SHIPPED["breakout"][0])
    cfg = RunConfig(task=named_task("breakout", None), steps=2000)
    for number, player in enumerate([None, [], {}, {"return_mean": "x"}, {"return_mean": None}]):
        place = tmp_path / str(number)
        Demonstration(demo.transitions, {**demo.card, "expert": player}).save(place)
        given = DemoConfig(path=str(place))
        assert obtain_demonstration(cfg, ExpertConfig(), given)[1] is None


def test_on_the_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["demo", "show", "shipped:breakout"]) == 0
    assert "breakout (ALE/Breakout-v5)" in capsys.readouterr().out
    words = ["task=breakout", "demo.path=shipped", "steps=0", "bc.steps=2", "logger=null", "out=a"]
    assert main(["run", "bc", *words, "eval.episodes=1", "task.max_episode_steps=30"]) == 0
    result = json.loads((tmp_path / "a" / "result.json").read_text())
    card = Demonstration.load(SHIPPED["breakout"][0]).card
    assert result["expert_return_mean"] == card["expert"]["return_mean"]
    assert result["seeds"]["demo"] == card["seed"]
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
    assert result["demo"] == "shipped:breakout/0" and len(result["demo_id"]) == 12
    assert main(["run", "bc", "task=hopper", "demo.path=shipped", "out=b"]) == 2
    assert "no demonstration of hopper is shipped" in capsys.readouterr().err
