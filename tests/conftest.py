"""A Gymnasium environment small enough to know by heart, and signals as tests expect them."""

import signal
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces

# Test files are imported one by one; this lets them share the modules beside this one.
sys.path.insert(0, str(Path(__file__).parent))
torch.set_num_threads(1)  # As the command line does; the default is slower for small networks.


class StepCounter(gymnasium.Env):
    """Observation (start, step, last action); reward ``100 * step + action``.

    ``start`` is drawn from the episode's seed. An episode fails after ``length`` steps, or after a
    number drawn from the seed where that is None. One array is returned for all observations, not
    copied, as some simulators do.
    """

    def __init__(self, length=None, discrete=False):
        self.observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float32)
        box = spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.action_space = spaces.Discrete(3) if discrete else box
        self.length = length
        self._observation = np.zeros(3, dtype=np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._observation[:] = self.np_random.uniform(), 0.0, 0.0
        self._end = self.length or int(self.np_random.integers(1, 12))
        return self._observation, {}

    def step(self, action):
        number = float(np.asarray(action).sum())
        self._observation[1] += 1.0
        self._observation[2] = number
        step = float(self._observation[1])
        return self._observation, 100.0 * step + number, step >= self._end, False, {}


if "StepCounter-v0" not in gymnasium.registry:
    gymnasium.register("StepCounter-v0", entry_point=StepCounter, max_episode_steps=10_000)


@pytest.fixture(autouse=True)
def same_random_numbers():
    """torch's own first seed is another one in each process."""
    torch.manual_seed(0)


@pytest.fixture(autouse=True)
def heeded_ctrl_c():
    """Tests send SIGINT, which a process that a script starts in the background ignores."""
    before = signal.getsignal(signal.SIGINT)
    if before is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    if before is signal.SIG_IGN:
        signal.signal(signal.SIGINT, before)


@pytest.fixture
def step_counter():
    return StepCounter
