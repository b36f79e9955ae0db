"""Short runs: their settings, how tests stop them, and what of them is compared."""

import signal
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

import gymnasium
import numpy as np
import pytest

from giril_rl.runs.checkpoint import load_state
from giril_rl.runs.metrics import read_metrics
from giril_rl.runs.run import Run

TINY = ("ppo.num_envs=2", "ppo.rollout=8", "ppo.minibatch=8", "ppo.epochs=1", "ppo.hidden=[4]")
TINY += ("logger=null",)


class Killed(Exception):
    """Stands for kill -9: nothing is saved after it."""


@contextmanager
def stopped(how, at):
    """The run in this ``with`` gets Ctrl-C, or is Killed, when it logs step ``at`` or a later one.

    Args:
        how: Killed or Interrupted, which must leave the ``with``.
        at: the step.
    """
    log = Run.log

    def log_and_stop(self, step, values, *, phase):
        log(self, step, values, phase=phase)
        if step >= at:
            if how is Killed:
                raise Killed
            signal.raise_signal(signal.SIGINT)

    with patch.object(Run, "log", log_and_stop), pytest.raises(how):
        yield


class Garbage(gymnasium.Wrapper):
    """An environment whose reward is noise, NaN or, for another ``kind``, its own."""

    def __init__(self, env, kind):
        super().__init__(env)
        self.rng = np.random.default_rng(7)
        self.kind = kind

    def step(self, action):
        observation, reward, *rest = self.env.step(action)
        if self.kind == "noise":
            reward = 1e3 * self.rng.normal()
        elif self.kind == "nan":
            reward = float("nan")
        return observation, reward, *rest


def rows(folder):
    """A run's metrics without the times."""
    found = read_metrics(Path(folder) / "metrics.jsonl")
    return [{k: v for k, v in row.items() if "seconds" not in k} for row in found]


def weights(folder):
    """Every tensor of a run's policy, bit for bit."""
    state = load_state(Path(folder) / "policy/model.safetensors")
    return {name: (str(value.dtype), value.tolist()) for name, value in state.items()}
