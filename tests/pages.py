"""What each page needs before it is run, and what must hold after it, see test_pages.py."""

import importlib.util
import sys
from pathlib import Path

import gymnasium
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector

from giril_rl import IntrinsicReward
from giril_rl.config.schema import TaskConfig
from giril_rl.demos import Demonstration, record_demonstration
from giril_rl.envs import AtariGymEnv, gym_factory, make_env
from giril_rl.policies import agent_for
from giril_rl.rewards import GenerativeReward
from giril_rl.rewards import fit as whole_fit

BALL = Path(__file__).parents[1] / "docs/tutorials/giril_on_your_environment.py"
GENERATED = {"docs/results/pybullet/report.md", "docs/results/pybullet-sac/report.md"}
CARTPOLE = TaskConfig(name="cartpole", env_id="CartPole-v1")
PENDULUM = TaskConfig(name="pendulum", env_id="Pendulum-v1")


def nothing(*_):
    """A page that needs nothing."""


def quick_fit(loss, demonstration, **settings):
    """A few steps of the many that a page has."""
    return whole_fit(loss, demonstration, **{**settings, "steps": 3})


def reader(monkeypatch, _=None):
    """What a reader has who has a TorchRL project: environment, policy and demonstration."""
    monkeypatch.setattr("giril_rl.rewards.fit", quick_fit)
    env = make_env(PENDULUM, 2, seed=0)
    agent = agent_for(env, hidden=[8], normalise=False)
    demonstration = env.rollout(20)
    return {
        "env": env,
        "policy": agent.acting(),
        "agent": agent,
        "demonstration": demonstration,
        "observation_dim": 3,
    }


def readme(monkeypatch, _):
    for folder in ("runs/giril/inverted_pendulum/default/seed0",):
        Path(folder).mkdir(parents=True)
    demo = record_demonstration(
        gym_factory(CARTPOLE), lambda o: o.new_ones(1).long(), length=30, seed=0
    )
    demo.save("runs/demos/inverted_pendulum/HASH")
    return reader(monkeypatch)


def readme_after(names):
    batch = next(iter(names["collector"]))
    assert (batch["next", "reward"] != batch["next", "extrinsic_reward"]).all()
    names["collector"].shutdown()


def sharing(monkeypatch, _):
    found = reader(monkeypatch)
    folder = "runs/giril/inverted_pendulum/default/seed0"
    GenerativeReward.for_vectors(3, found["env"].action_spec).save_pretrained(f"{folder}/reward")
    found["agent"].save_pretrained(f"{folder}/policy")
    return {**found, "Collector": Collector, "IntrinsicReward": IntrinsicReward}


def study_of(file):
    """The page's YAML under the name that it gives it."""

    def write(_, found):
        Path("runs").mkdir()
        (text,) = [text for _, kind, text in found if kind == "yaml"]
        Path(file).write_text(text)

    return write


def runs(*_):
    Path("runs").mkdir()


def reuse_after(names):
    assert (names["batch"]["next", "reward"] != names["batch"]["next", "extrinsic_reward"]).all()
    names["collect"](TensorDictModule(nn.Linear(3, 1), ["observation"], ["action"]))


def extending(*_):
    """The module that registers the page's environment, and a demonstration of it."""
    text = BALL.read_text("utf-8")
    Path("my_envs.py").write_text(text.replace("BallOnBeam-v0", "Ball-v0"))
    tutorial().play(Path("mine.npz"), episodes=1)
    Path("runs/giril/my_envs-Ball-v0/default/seed0").mkdir(parents=True)


def extending_after(names):
    batch = TensorDict({"observation": torch.zeros(4, 2)}, [4])
    batch["next"] = TensorDict({"observation": torch.ones(4, 2), "reward": torch.zeros(4, 1)}, [4])
    assert torch.allclose(names["relabel"](batch)["next", "reward"], torch.tensor(2.0).sqrt())
    assert names["Config"]().strength == 1.0
    # Other tests ask which ids are near to one that is not there.
    gymnasium.registry.pop("Ball-v0")
    sys.modules.pop("my_envs")


class NoKeys:
    """Nobody plays."""

    def __init__(self, title):
        assert title == "breakout"

    def show(self, frame):
        return frozenset({"right"})

    def close(self):
        pass


def demonstrations(monkeypatch, _):
    pytest.importorskip("ale_py")
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", "minari")
    monkeypatch.setattr("giril_rl.demos.play.Window", NoKeys)
    record_demonstration(
        lambda: AtariGymEnv("breakout"), lambda o: torch.tensor([0]), length=3, seed=0
    ).save("runs/demos/breakout/0a1b2c3d4e5f")


def demonstrations_after(_):
    mine, again = Demonstration.load("demos/mine"), Demonstration.load("demos/again")
    assert (mine.transitions == again.transitions).all()
    assert Demonstration.load("demos/played").card["deterministic"] == "by hand"
    assert Demonstration.load("demos/rollout").has_rewards and not mine.has_rewards
    assert Path("breakout.gif").is_file() and Path("again.npz").is_file()


def tutorial():
    """The tutorial's module, under a name of no importance."""
    spec = importlib.util.spec_from_file_location("ball", BALL)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def ball(*_):
    """What the script leaves in the folder, and the run."""
    for folder in ("ball", "runs/ball"):
        Path(folder).mkdir(parents=True)
    tutorial().play(Path("ball/ball.npz"), episodes=1)


def ball_after(_):
    assert Demonstration.load("demos/ball").card["env_id"] == "ball_on_beam:BallOnBeam-v0"


OF = {
    "docs/tutorials/giril_on_your_environment.py": (ball, ball_after),
    "README.md": (readme, readme_after),
    "docs/quickstart.md": (runs, nothing),
    "docs/reproduce.md": (study_of("games.yaml"), nothing),
    "docs/results/pybullet.md": (runs, nothing),
    "docs/results/pybullet-sac.md": (runs, nothing),
    "docs/results/atari.md": (runs, nothing),
    "docs/results/no-survival.md": (runs, nothing),
    "docs/results/ablations.md": (runs, nothing),
    "docs/sharing.md": (sharing, nothing),
    "docs/studies.md": (study_of("my_study.yaml"), nothing),
    "docs/reuse.md": (nothing, reuse_after),
    "docs/extending.md": (extending, extending_after),
    "docs/demonstrations.md": (demonstrations, demonstrations_after),
}
