"""What a machine or a training may do to a run: one sentence, and what was saved stays."""

import os
import random
import re
import signal
import subprocess
import sys
import time

import gymnasium
import pytest
import torch
from folders import assert_readable, assert_same, contents
from tiny import RECIPES, words
from torch import nn

from giril_rl.config.schema import BCConfig, FitConfig, PPOConfig, TaskConfig
from giril_rl.demos import record_demonstration
from giril_rl.envs import GymVectorEnv, gym_factory, make_env
from giril_rl.errors import FAILED, RunError, UserError
from giril_rl.rewards import GenerativeReward, GenerativeRewardLoss
from giril_rl.runs.checkpoint import load_state
from giril_rl.training import PPO, Run, clone_behaviour, fit_reward, make_agent, train_policy
from giril_rl.transforms import ReturnScaling

TASK = TaskConfig(name="cartpole", env_id="CartPole-v1")
SMALL = PPOConfig(num_envs=2, rollout=32, minibatch=64, epochs=1, hidden=[8], checkpoint_every=64)
DISK = {"ENOSPC": "No space left on device", "EROFS": "Read-only file system"}


def only_sentence(ended):
    """The last line of a command that failed, which is all that it says of the failure."""
    assert ended.code == FAILED, ended.words
    assert "Traceback" not in ended.words
    said = [line for line in ended.words.splitlines() if line.startswith("giril: ")]
    assert said == ended.words.splitlines()[-1:]
    return said[0]


def meets(nursery, recipe, root, error, number):
    """A run whose writes fail from a number on; whether there were so many."""
    ended = nursery.run(words(recipe, root), root=str(root), error=error, error_at=number)
    assert_readable(root)
    if ended.code == 0:
        return False
    sentence = only_sentence(ended)
    assert f"({DISK[error]}): " in sentence and str(root) in sentence, sentence
    return True


def test_a_full_disk(nursery, tmp_path):
    """Number 31 is in the run's policy training; the same command then goes on."""
    assert meets(nursery, "control", tmp_path, "ENOSPC", 31)
    assert nursery.run(words("control", tmp_path)).code == 0
    assert not list(tmp_path.rglob(".*.tmp"))


@pytest.mark.slow
@pytest.mark.parametrize("error", DISK)
@pytest.mark.parametrize("recipe", RECIPES)
def test_a_disk_that_fails_at_any_write(recipe, error, nursery, tmp_path):
    assert nursery.run(words(recipe, tmp_path / "whole")).code == 0
    expected = contents(tmp_path / "whole")
    chosen = sorted(random.Random(f"{recipe} {error}").sample(range(2, 60), 5))
    failed = [
        number for number in chosen if meets(nursery, recipe, tmp_path / "run", error, number)
    ]
    assert failed
    assert nursery.run(words(recipe, tmp_path / "run")).code == 0
    assert_same(contents(tmp_path / "run"), expected, f"{recipe}, {error} at {failed}")


@pytest.mark.parametrize("place", ["file/run", "file"])
def test_a_place_below_a_file(place, nursery, tmp_path):
    (tmp_path / "file").write_text("mine")
    ended = nursery.run(words("expert", tmp_path, out=tmp_path / place))
    assert ended.code == 2, ended.words
    assert ended.words.count("\n") == 1 and "choose another" in ended.words
    assert (tmp_path / "file").read_text() == "mine"


def trained(folder, relabel, **changes):
    """PPO with the reward that ``relabel`` writes."""
    cfg = PPOConfig(**{**SMALL.__dict__, **changes})
    env = make_env(TASK, cfg.num_envs, 0)
    agent = make_agent(env, cfg, 0)
    with Run.open(folder, {}, recipe="x") as run:
        train_policy(env, PPO(agent, cfg, steps=64 * 4), relabel, seed=0, run=run)


class Breaks(nn.Module):
    """A reward of 1 that from its third batch on is something else."""

    def __init__(self, value):
        super().__init__()
        self.value, self.calls = value, 0

    def forward(self, batch):
        self.calls += 1
        reward = torch.ones_like(batch["next", "reward"])
        reward[0, 5] = self.value if self.calls > 2 else 1.0
        return batch.set(("next", "reward"), reward)


@pytest.mark.parametrize("scaled", [False, True])
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_reward_that_is_no_number(value, scaled, tmp_path):
    def relabel(value):
        return nn.Sequential(Breaks(value), *[ReturnScaling()] * scaled)

    what = rf"next reward is {value} at \[0, 5, 0\] of the batch, so that loss_\w+ is \w+"
    if scaled:
        what = f"the reward is {value} in environment 0 at step 5 of the batch"
    with pytest.raises(RunError, match=f"{what} at 192 of 256 steps: see where that comes from"):
        trained(tmp_path, relabel(value))
    saved = load_state(tmp_path / "ppo.safetensors")
    assert saved["steps"] == 128
    weights = [v for v in saved["algorithm"]["agent"].values() if v.is_floating_point()]
    assert weights and all(v.isfinite().all() for v in weights)
    # The same folder goes on from there once its reward is sound.
    trained(tmp_path, relabel(1.0))
    assert load_state(tmp_path / "ppo.safetensors")["steps"] == 256


class BadSensor(gymnasium.Wrapper):
    """From its 80th step on one entry of the observation is ``value``."""

    def __init__(self, value):
        super().__init__(gymnasium.make("CartPole-v1"))
        self.value, self.steps = value, 0

    def step(self, action):
        observation, *rest = self.env.step(action)
        self.steps += 1
        if self.steps >= 80:
            observation[2] = self.value
        return observation, *rest


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_an_observation_that_is_no_number_is_named(value, tmp_path):
    """An infinity is clipped on its way to the loss, and would spoil the running statistics."""
    env = GymVectorEnv(lambda: BadSensor(value), SMALL.num_envs, seed=0, max_episode_steps=500)
    agent = make_agent(env, SMALL, 0)
    with (
        Run.open(tmp_path, {}, recipe="x") as run,
        pytest.raises(RunError, match=rf"observation is {value} at \[0, \d+, 2\] of the batch at"),
    ):
        train_policy(env, PPO(agent, SMALL, steps=64 * 4), Breaks(1.0), seed=0, run=run)
    assert env.is_closed
    assert agent.normaliser.mean.isfinite().all()


@pytest.mark.parametrize(
    ("broken", "sentence"),
    [
        ("actor.0.weight", r"actor\.0\.weight has weights that are not finite at 192"),
        ("normaliser.mean", r"normaliser\.mean has statistics that are not numbers at 192"),
    ],
)
def test_what_is_no_number_is_not_saved(broken, sentence, tmp_path, monkeypatch):
    """The end of an update may break what all losses were computed with before."""
    from giril_rl.training.ppo import PPO

    learn = PPO.update

    def learn_and_break(self, batch):
        losses = learn(self, batch)
        if self.state_dict()["steps"] == 192:
            self.agent.state_dict()[broken].view(-1)[0] = float("nan")
        return losses

    monkeypatch.setattr(PPO, "update", learn_and_break)
    with pytest.raises(RunError, match=sentence):
        trained(tmp_path, Breaks(1.0))
    assert load_state(tmp_path / "ppo.safetensors")["steps"] == 128


def test_too_large_a_step_size(nursery, tmp_path):
    command = words("expert", tmp_path, ppo__lr="1e30", ppo__epochs=2)
    sentence = only_sentence(nursery.run(command))
    assert "is nan at" in sentence or "is inf at" in sentence
    assert "give a smaller step size" in sentence
    assert not list((tmp_path / "expert").glob("*.safetensors"))


def test_a_discriminator_that_leaves_the_numbers(nursery, tmp_path):
    sentence = only_sentence(nursery.run(words("gail", tmp_path, reward__lr="1e38")))
    assert "discriminator/loss_" in sentence and " at 128 of 256 steps: " in sentence
    assert not list((tmp_path / "gail").glob("*.safetensors"))


def reward_of(env):
    return GenerativeReward.for_vectors(4, env.action_spec, hidden=[8], normalise="raw")


def test_fits_that_leave_the_numbers(tmp_path):
    env = make_env(TASK, 1, 0)
    played = record_demonstration(
        gym_factory(TASK), lambda o: o.new_ones(1).long(), seed=0, length=40
    )
    pairs = played.transitions
    reward = reward_of(env)
    with (
        Run.open(tmp_path / "fit", {}, recipe="x") as run,
        pytest.raises(RunError, match=r"fit/fitted/\w+ is (nan|inf) at 10 of 20 fitting steps"),
    ):
        cfg = FitConfig(steps=20, lr=1e30, log_every=10)
        fit_reward(GenerativeRewardLoss(reward), pairs, cfg, seed=0, run=run)
    agent = make_agent(env, SMALL, 0)
    bad = pairs.clone()
    bad["next", "observation"][7, 3] = float("nan")
    with (
        Run.open(tmp_path / "bad", {}, recipe="x") as run,
        pytest.raises(UserError, match=r"'observation'\) is nan at index \[7, 3\]: leave that"),
    ):
        fit_reward(GenerativeRewardLoss(reward_of(env)), bad, FitConfig(steps=20), seed=0, run=run)
    with (
        Run.open(tmp_path / "bc", {}, recipe="x") as run,
        pytest.raises(RunError, match=r"bc/fitted/loss is (nan|inf) at 10 of 20 gradient steps"),
    ):
        cfg = BCConfig(steps=20, lr=1e38, log_every=10, stop="fixed", weight_decay=0.0)
        clone_behaviour(agent, pairs, cfg, seed=0, run=run)
    assert not list(tmp_path.rglob("*.safetensors"))


STUDY = """
all: {task: inverted_pendulum, task.env_id: CartPole-v1, steps: 1280000, ppo.num_envs: 2,
  ppo.rollout: 64, ppo.minibatch: 64, ppo.epochs: 1, ppo.hidden: [8], eval.episodes: 1,
  logger: null}
groups:
  - {label: long, recipe: control, seed: 0}
  - {label: short, recipe: control, seed: 1, steps: 256}
"""


def commands(mark):
    """Processes by their id whose command has ``mark`` in it."""
    found = {}
    for entry in filter(str.isdigit, os.listdir("/proc")):
        try:
            with open(f"/proc/{entry}/cmdline", "rb") as file:
                line = file.read().decode(errors="replace").split("\0")
        except OSError:
            continue
        if any(mark in word for word in line):
            found[int(entry)] = line
    return found


def begun(folder):
    """The study's process, and the root of its runs."""
    (folder / "mine.yaml").write_text(STUDY)
    root = folder / "runs of this test"
    command = ["study", str(folder / "mine.yaml"), "jobs=2", "retries=0", f"root='{root}'"]
    process = subprocess.Popen(
        [sys.executable, "-m", "giril_rl", *command],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=folder,
    )
    return process, root


@pytest.mark.slow
def test_runs_save_and_stop_when_their_study_is_killed(tmp_path):
    process, root = begun(tmp_path)
    try:
        deadline = time.monotonic() + 300
        while not list(root.rglob("ppo.safetensors")) or not list(root.rglob("result.json")):
            assert process.poll() is None, process.stderr.read()
            assert time.monotonic() < deadline
            time.sleep(0.1)
    finally:
        process.kill()
        process.wait()
    deadline = time.monotonic() + 60
    while commands(str(root)):
        assert time.monotonic() < deadline
        time.sleep(0.1)
    assert_readable(root)
    (log,) = [
        text for path in root.rglob("*.log") if "interrupted in" in (text := path.read_text())
    ]
    assert "the study's process is gone" in log
    assert "1,280,000 steps: the same command continues from there." in log
    taken = int(re.search(r"interrupted in .+ at ([\d,]+) of", log)[1].replace(",", ""))
    (folder,) = [path.parent for path in root.rglob("ppo.safetensors") if "seed0" in str(path)]
    assert load_state(folder / "ppo.safetensors")["steps"] == taken > 0


@pytest.mark.slow
def test_a_worker_that_dies_is_listed_and_the_others_go_on(tmp_path):
    process, root = begun(tmp_path)
    try:
        deadline = time.monotonic() + 300
        while not (
            victims := [
                pid
                for pid, line in commands(str(root)).items()
                if "control" in line and "steps=1280000" in line
            ]
        ) or not list(root.rglob("result.json")):
            assert process.poll() is None, process.stderr.read()
            assert time.monotonic() < deadline
            time.sleep(0.1)
        (victim,) = victims
        os.kill(victim, signal.SIGKILL)
        _, error = process.communicate(timeout=120)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 1, error
    assert "giril: 1 of 2 runs failed:" in error and "killed by signal 9" in error
    assert len(list(root.rglob("result.json"))) == 1
    assert not commands(str(root))
    assert_readable(root)
