"""A deterministic environment small enough to know by heart."""

import gymnasium
import numpy as np
from gymnasium import spaces


class Counter(gymnasium.Env):
    """Observation (seed's start + sum of actions, step); ends after ``horizon`` steps, reward 1."""

    def __init__(self, horizon=5, action_space=None):
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.action_space = action_space or spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.horizon = horizon
        self._observation = np.zeros(2, dtype=np.float32)  # returned, not copied, as some do

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._observation[:] = self.np_random.uniform(), 0
        return self._observation, {}

    def step(self, action):
        assert self.action_space.contains(action)
        self._observation += (float(np.asarray(action).sum()), 1.0)
        return self._observation, 1.0, bool(self._observation[1] >= self.horizon), False, {}
