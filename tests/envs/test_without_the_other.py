"""Atari runs where PyBullet is not installed, and PyBullet where ale-py is not."""

import subprocess
import sys

import pytest

CODE = """
import importlib.abc, sys

class Missing(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name.split(".")[0] in {missing!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Missing())
import recipes.giril
from giril_rl.demos import named_task
from giril_rl.envs import make_env
from giril_rl.training import evaluate, make_agent
from giril_rl.config.schema import PPOConfig
from dataclasses import replace

task = replace(named_task({task!r}, None), max_episode_steps=20)
agent = make_agent(make_env(task, 1, seed=0), PPOConfig(hidden=[4]), seed=0)
print(evaluate(agent, task, episodes=1, seed=0, deterministic=False).episode_length_mean)
"""


@pytest.mark.parametrize(
    ("task", "missing"),
    [
        ("breakout", ["pybullet", "pybullet_data", "pybullet_utils", "pybullet_envs_gymnasium"]),
        ("inverted_pendulum", ["ale_py", "cv2"]),
    ],
)
def test_the_other_simulator_is_not_needed(task, missing):
    code = CODE.format(task=task, missing=missing)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert 1 <= float(done.stdout) <= 20
