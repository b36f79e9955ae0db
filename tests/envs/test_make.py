import gymnasium
import pytest

from giril_rl.config.schema import TaskConfig
from giril_rl.envs import gym_factory, make_env
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
