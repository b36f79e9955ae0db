"""From a task to its environment, whichever family it is of, a user's own included."""

import json
import sys
from pathlib import Path

import gymnasium
import pytest
import torch

from giril_rl.cli.command_line import main
from giril_rl.config import families
from giril_rl.config.families import TaskFamily, family_of
from giril_rl.config.schema import TaskConfig
from giril_rl.config.tasks import task_defaults
from giril_rl.envs import gym_factory, make_env, observation_kind, register_family
from giril_rl.envs.gym_api import import_package
from giril_rl.errors import UserError


def refused(env_id, **kwargs):
    with pytest.raises(UserError) as raised:
        gym_factory(TaskConfig(name="test", env_id=env_id, **kwargs))()
    message = str(raised.value)
    assert "\n" not in message and message[-1] in ".?"
    return message


def test_unknown_id_names_the_nearest(monkeypatch):
    assert "CartPol-v1 is not a Gymnasium id; did you mean 'CartPole" in refused("CartPol-v1")
    assert "InvertedPendulumBulletEnv-v0" in refused("InvertedPendulmBulletEnv-v0")
    monkeypatch.setattr(gymnasium, "registry", {})  # Other tests may have added what is near.
    assert refused("zzz") == (
        "task.env_id=zzz is not a Gymnasium id; check its name, or name the module that registers "
        "it: MODULE:ID."
    )
    assert refused("not_imported:Ball-v0") == (
        "task.env_id=not_imported:Ball-v0 is not a Gymnasium id here: its module not_imported is "
        "not imported; name it with imports=[not_imported] or --import not_imported, or import it."
    )
    assert refused("gymnasium:Ball-v0") == (
        "task.env_id=gymnasium:Ball-v0 is not a Gymnasium id that gymnasium registers: check its "
        "name."
    )


@pytest.mark.parametrize("env_id", ["CartPole-v99", "no_such_package:Walk-v0", "a b", "x/y/z", ""])
def test_odd_ids_are_refused_not_crashed_on(env_id):
    assert "is not a Gymnasium id" in refused(env_id)


@pytest.fixture
def endless(step_counter):
    gymnasium.register("Endless-v0", entry_point=step_counter)
    yield "Endless-v0"
    del gymnasium.registry["Endless-v0"]


def test_a_task_without_time_limit_is_refused(endless):
    assert "no time limit" in refused(endless)
    assert "set task.max_episode_steps" in refused(endless)
    task = TaskConfig(name="test", env_id=endless, max_episode_steps=7)
    env = make_env(task, 1, seed=0)
    assert env.rollout(7, break_when_any_done=False)["next", "done"].any()


def test_the_tasks_limit_goes_before_the_registered_one():
    task = TaskConfig(name="test", env_id="Pendulum-v1", max_episode_steps=3)
    assert make_env(task, 1, seed=0).rollout(50)["next", "truncated"].flatten().tolist() == [
        False,
        False,
        True,
    ]


def test_missing_packages_are_named(monkeypatch):
    with pytest.raises(UserError, match=r"needs no_such_package.* pip install no_such_"):
        import_package("no_such_package")

    def make(*args, **kwargs):
        raise gymnasium.error.DependencyNotInstalled("Box2D is not there, run `pip install b`.")

    monkeypatch.setattr(gymnasium, "make", make)
    assert "CartPole-v1 needs another package: Box2D" in refused("CartPole-v1")


@pytest.mark.parametrize(
    ("entry", "told"),
    [
        ("no_such_module:Env", "needs the module no_such_module, which is not installed"),
        ("tests_of_families:NoSuchClass", r"cannot be made \(AttributeError: "),
        ("tests_of_families:Broken", r"cannot be made \(ValueError: out of order\)"),
        ("tests_of_families:Wants", r"cannot be made \(TypeError: "),
    ],
)
def test_what_cannot_be_made_is_told_in_a_sentence(entry, told, tmp_path, monkeypatch):
    (tmp_path / "tests_of_families.py").write_text(
        "import gymnasium\n"
        "class Broken(gymnasium.Env):\n"
        "    def __init__(self): raise ValueError('out of order')\n"
        "class Wants(gymnasium.Env):\n"
        "    def __init__(self, size): pass\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    name = f"Unmakeable{abs(hash(entry))}-v0"
    gymnasium.register(name, entry, max_episode_steps=5)
    with pytest.raises(UserError, match=told):
        make_env(TaskConfig(name="unmakeable", env_id=name), 1, seed=0)


BOXES = '''
import gymnasium
import numpy as np

from giril_rl.envs import TaskFamily, register_family


class Push(gymnasium.Env):
    """A bright row moves up or down; 20 steps."""

    observation_space = gymnasium.spaces.Box(0, 255, (2, 84, 84), np.uint8)
    action_space = gymnasium.spaces.Discrete(3)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.row = int(self.np_random.integers(84))
        return self.image(), {}

    def step(self, action):
        self.row = (self.row + int(action) - 1) % 84
        return self.image(), float(self.row == 0), False, False, {}

    def image(self):
        image = np.zeros((2, 84, 84), np.uint8)
        image[:, self.row] = 255
        return image


gymnasium.register("Boxes/Push-v0", entry_point=Push, max_episode_steps=20)
register_family(TaskFamily("boxes", "Boxes/", observation="image", settings="atari"))
'''


@pytest.fixture
def boxes(tmp_path, monkeypatch):
    """A folder with a module that registers a family with images; taken back at the end."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(families, "_families", families._families.copy())
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry])
    Path("boxes.py").write_text(BOXES)
    yield "boxes:Boxes/Push-v0"
    sys.modules.pop("boxes", None)
    gymnasium.registry.pop("Boxes/Push-v0", None)


def test_a_familys_images_go_through_a_recipe(boxes):
    """One file of the user's: its settings, its pixel networks and its score are found."""
    words = [f"task.env_id={boxes}", "reward=constant", "steps=32", "logger=null", "out=run"]
    words += ["ppo.num_envs=2", "ppo.rollout=8", "ppo.minibatch=8", "ppo.epochs=1"]
    assert main(["run", "control", *words, "eval.episodes=2"]) == 0
    config = Path("run/config.yaml").read_text()
    assert "normalise_observations: false" in config and "clip_value: true" in config
    card = json.loads(Path("run/policy/card.json").read_text())
    assert card["made_by"]["class"] == "PixelActorCritic"
    assert json.loads(Path("run/result.json").read_text())["episode_length_mean"] == 20

    task = TaskConfig(name="push", env_id=boxes)
    env, other = make_env(task, 3, seed=1), make_env(task, 3, seed=9)
    assert observation_kind(env) == "image"
    env.rollout(8, break_when_any_done=False)
    assert other.restore_simulator(env.simulator_state())
    again = other.reset()["observation"]
    assert again.dtype == torch.uint8 and again.any()
    assert torch.equal(again, torch.from_numpy(env._last_observation))


def test_a_family_of_images_refuses_vectors(monkeypatch):
    monkeypatch.setattr(families, "_families", families._families.copy())
    register_family(TaskFamily("poles", "CartPole", observation="image"))
    with pytest.raises(UserError, match=r"needs uint8 \(channels, height, width\)"):
        make_env(TaskConfig(name="cartpole", env_id="CartPole-v1"), 1, seed=0)


def test_a_familys_settings_are_those_of_its_tasks(monkeypatch):
    monkeypatch.setattr(families, "_families", families._families.copy())
    for scale in (2.0, 3.0):  # The second takes the first one's place.
        families.register_task_family(
            TaskFamily("poles", "CartPole", settings={"giril": {"scale": scale}})
        )
    assert task_defaults("CartPole-v1") == {"giril.scale": 3.0}
    assert task_defaults("CartPole-v1", chosen=["giril"]) == {}
    assert (family_of("ALE/Pong-v5"), family_of("x:Pendulum-v1")) == (
        families.ATARI,
        families.GYMNASIUM,
    )
