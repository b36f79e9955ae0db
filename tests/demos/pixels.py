"""A game of stacked frames small enough to know by heart."""

import gymnasium
import numpy as np
from gymnasium import spaces


class Pixels(gymnasium.Env):
    """A bright pixel moves by the action; every third step loses a life, of two.

    Three frames of 5 x 4 are stacked, the latest last. Where a life is lost in the middle of a
    game, the stack is cleared but for the latest frame.
    """

    def __init__(self, *, whole_games=False):
        self.observation_space = spaces.Box(0, 255, (3, 5, 4), np.uint8)
        self.action_space = spaces.Discrete(3)
        self._whole_games = whole_games
        self._stack = np.zeros((3, 5, 4), dtype=np.uint8)

    def get_action_meanings(self):
        return ["NOOP", "LEFT", "RIGHT"]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._steps = 0
        self._place = int(self.np_random.integers(20))
        self._stack[:] = 0
        self._draw()
        return self._stack, {}

    def step(self, action):
        self._steps += 1
        self._place = (self._place + 7 * action + 1) % 20
        self._stack[:-1] = self._stack[1:]
        over = self._steps == 6 or (self._steps == 3 and not self._whole_games)
        if self._steps == 3 and not over:
            self._stack[:] = 0
        self._draw()
        return self._stack, float(action), over, False, {}

    def _draw(self):
        self._stack[-1] = self._steps
        self._stack[-1].flat[self._place] = 255


def steer(observation):
    """Depends on the image, so that an action one step off shows."""
    assert observation.shape == (1, 3, 5, 4)
    return observation[:, -1].flatten(1).argmax(1) % 3
