import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent))

from counter import Counter

from giril_rl.demos import record_demonstration


def push(observation):
    """Depends on the state, so that an action one step off shows."""
    return observation[:, 1:] * 0.125 + 0.0625


@pytest.fixture
def make_fn():
    return Counter


@pytest.fixture
def demo():
    """Episodes of 5, 5 and 2 transitions, the last one cut."""
    return record_demonstration(Counter, push, length=12, seed=0, task="counter")


@pytest.fixture
def whole():
    return record_demonstration(Counter, push, episodes=2, seed=0)


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)
