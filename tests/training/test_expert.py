from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tensordict.nn import TensorDictModule

from giril_rl.config.schema import DemoConfig, ExpertConfig, RunConfig, TaskConfig
from giril_rl.demos import Demonstration
from giril_rl.envs import as_recorded_task
from giril_rl.errors import UserError
from giril_rl.training import check_inputs, demonstrations, obtain_demonstration

COUNTER = TaskConfig(name="counter", env_id="StepCounter-v0")
BREAKOUT = TaskConfig(name="breakout", env_id="ALE/Breakout-v5")
LIFE = DemoConfig(length=None, episodes=1, deterministic=False)


class Random:
    """Plays without a look at what it is shown."""

    def __init__(self, actions):
        self.actions = actions

    def acting(self):
        def act(observation):
            return torch.randint(self.actions, observation.shape[:1])

        return TensorDictModule(act, ["observation"], ["action"])


@pytest.fixture
def obtain(monkeypatch, tmp_path):
    result = {"config_hash": "0123456789ab", "return_mean": 3.5, "seed": 7, "env_steps": 9}
    monkeypatch.setattr(demonstrations, "obtain_expert", lambda *_: (Path("expert"), result))
    monkeypatch.setattr(demonstrations, "load_agent", lambda *_: Random(actions=4))

    def obtain(task, demo):
        config = RunConfig(task=task, root=str(tmp_path), steps=2000)
        found, _ = obtain_demonstration(config, ExpertConfig(), demo)
        return found, {path.parent for path in tmp_path.glob("demos/*/*/card.json")}

    return obtain


def test_hashes_are_those_of_before_there_were_lives():
    assert demonstrations._identity(COUNTER, DemoConfig(seed=0), "0123456789ab") == "7ed61d6c8859"
    task = replace(COUNTER, horizon="fixed")
    demo = DemoConfig(
        length=None, episodes=2, subsample=1, lives="all", seed=0
    )  # Nothing to a vector.
    recorded = as_recorded_task(task, demo.lives)
    assert demonstrations._identity(recorded, demo, "0123456789ab") == "36962a564bd0"


def test_lives_decide_where_an_atari_episode_ends(obtain):
    pytest.importorskip("ale_py")
    first, folders = obtain(BREAKOUT, LIFE)
    assert (first.num_episodes, first.card["lives"], len(folders)) == (1, "first", 1)
    assert first.card["expert"] == {"return_mean": 3.5, "seed": 7, "env_steps": 9}
    # How the policy trains changes nothing about what is recorded.
    again, folders = obtain(replace(BREAKOUT, episode="game"), LIFE)
    assert (len(again), len(folders)) == (len(first), 1)
    whole, folders = obtain(BREAKOUT, replace(LIFE, lives="all"))
    assert (whole.num_episodes, whole.card["lives"], len(folders)) == (1, "all", 2)
    assert len(whole) > len(first)
    # The same game: its first life is the whole one-life demonstration but for its last stack.
    same = first.transitions["observation"] == whole.transitions["observation"][: len(first)]
    assert same.all()


def test_a_given_demonstration_must_fit_the_task(obtain, tmp_path):
    pytest.importorskip("ale_py")
    _, (folder,) = obtain(BREAKOUT, LIFE)
    given = DemoConfig(path=str(folder))
    config = RunConfig(task=BREAKOUT, root=str(tmp_path), steps=2000)
    check_inputs(config, ExpertConfig(), given)
    demo, result = obtain_demonstration(config, ExpertConfig(), given)
    assert result == {"return_mean": demo.card["expert"]["return_mean"]} and demo.has_images
    with pytest.raises(UserError, match=r"fit counter: the demonstration is of ALE/Breakout-v5"):
        check_inputs(replace(config, task=COUNTER), ExpertConfig(), given)
    Demonstration(demo.transitions, {}).save(tmp_path / "unknown")
    given = DemoConfig(path=str(tmp_path / "unknown"))
    with pytest.raises(
        UserError,
        match=r"fit counter: the demonstration has observations of shape \[4, 84, 84\] and the "
        r"task of shape \[3\]: use a demonstration of this task\.",
    ):
        check_inputs(replace(config, task=COUNTER), ExpertConfig(), given)


def test_a_demonstration_is_recorded_once(obtain, monkeypatch):
    pytest.importorskip("ale_py")
    first, _ = obtain(BREAKOUT, LIFE)
    monkeypatch.setattr(
        demonstrations, "record_demonstration", lambda *_, **__: pytest.fail("again")
    )
    again, (folder,) = obtain(BREAKOUT, LIFE)
    assert (again.transitions == first.transitions).all()
    assert isinstance(Demonstration.load(folder), Demonstration)
