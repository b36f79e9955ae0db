"""A simulator that does not repeat itself: an interrupted run goes on, and says that it did."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.wrappers import TimeLimit
from torch import nn
from torchrl.envs import Compose

from giril_rl.config.schema import EvalConfig, PPOConfig, RunConfig, TaskConfig
from giril_rl.envs import GymVectorEnv
from giril_rl.runs.checkpoint import load_state
from giril_rl.runs.finished import read_result
from giril_rl.runs.metrics import read_metrics
from giril_rl.training import PPO, RandomPolicy, Run, Trained, finish_run, make_agent
from giril_rl.training.episodes import EpisodeTracker
from giril_rl.training.loop import forget_episodes, train_policy
from giril_rl.transforms import ReturnScaling

BATCH = 4 * 32
CFG = PPOConfig(
    num_envs=4, rollout=32, minibatch=64, epochs=1, hidden=[8], checkpoint_every=2 * BATCH
)


class Restless(gymnasium.Wrapper):
    """Its observations are other ones each time."""

    def step(self, action):
        observation, *rest = self.env.step(action)
        return observation + np.random.uniform(size=observation.shape), *rest


class Stopped(Exception):
    """Stands for the end of the process."""


def train(step_counter, folder, monkeypatch, *, stop=None, saves=False):
    """Trains on episodes of 20 steps; stops in batch number ``stop``, before or after saving."""
    env = GymVectorEnv(lambda: TimeLimit(Restless(step_counter(length=99)), 20), 4)
    log, save, reached = Run.log, Run.save, []

    def log_or_stop(self, step, values, *, phase):
        log(self, step, values, phase=phase)
        reached.append(step // BATCH)
        if reached[-1] == stop and not saves:
            raise Stopped

    def save_or_stop(self, name, state):
        save(self, name, state)
        if reached[-1] == stop:
            raise Stopped

    with monkeypatch.context() as patch, Run.open(folder, {}, recipe="x") as run:
        patch.setattr(Run, "log", log_or_stop)
        patch.setattr(Run, "save", save_or_stop)
        return train_policy(
            env, PPO(make_agent(env, CFG, 0), CFG, steps=6 * BATCH), nn.Identity(), seed=0, run=run
        )


def test_it_goes_on_from_fresh_episodes_and_counts_how_often(step_counter, tmp_path, monkeypatch):
    with pytest.raises(Stopped):
        train(step_counter, tmp_path, monkeypatch, stop=2, saves=True)
    assert load_state(tmp_path / "ppo.safetensors")["inexact_resumes"] == 0
    warning = r"did not come back .* at 256 steps with fresh episodes, .* inexact_resumes"
    # What is made after this one's start is lost with it, and so does not count.
    with pytest.warns(UserWarning, match=warning), pytest.raises(Stopped):
        train(step_counter, tmp_path, monkeypatch, stop=3)
    with pytest.warns(UserWarning, match=warning), pytest.raises(Stopped):
        train(step_counter, tmp_path, monkeypatch, stop=4, saves=True)
    assert load_state(tmp_path / "ppo.safetensors")["inexact_resumes"] == 1
    with pytest.warns(UserWarning, match="at 512 steps"):
        trained = train(step_counter, tmp_path, monkeypatch)
    assert trained.steps == 6 * BATCH and trained.inexact_resumes == 2
    # Only loaded, nothing is resumed.
    assert train(step_counter, tmp_path, monkeypatch).inexact_resumes == 2
    # The steps of an episode that was cut off are not added to those of the next one.
    lengths = [row.get("train/length_mean") for row in read_metrics(tmp_path / "metrics.jsonl")]
    assert lengths == [20.0] * 6


def test_the_sums_of_lost_episodes_are_forgotten():
    done, never = ReturnScaling(0.9, reset="done"), ReturnScaling(0.9)
    tracker = EpisodeTracker(2)
    for scaling in (done, never):
        scaling.running_return = torch.tensor([2.0, 3.0], dtype=torch.float64)
    tracker.running_return.fill_(5.0)
    tracker.running_length.fill_(7)
    forget_episodes(tracker, Compose(done, never))
    assert not tracker.running_return.any() and not tracker.running_length.any()
    assert done.running_return.tolist() == [0.0, 0.0]
    assert never.running_return.tolist() == [2.0, 3.0]  # It knows of no episodes.


def test_result_json_says_it(tmp_path):
    task = TaskConfig(name="cartpole", env_id="CartPole-v1")
    cfg = RunConfig(task=task, eval=EvalConfig(episodes=1))
    with Run.open(tmp_path, {}, recipe="x") as run:
        finish_run(run, cfg, RandomPolicy.of_task(task), Trained(0, 1.0, 3))
    assert read_result(tmp_path)["inexact_resumes"] == 3
