"""One Atari game as a Gymnasium environment: what demonstrations are recorded and replayed in."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict

from giril_rl.envs.atari import STACK, AtariEnv, Episode
from giril_rl.envs.atari_game import FRAME_CAP, SIDE


class AtariGymEnv(gymnasium.Env):
    """What :class:`AtariEnv` shows of a single game, in Gymnasium's terms.

    A reset with a seed begins the game of that seed. A reset without one after a lost life goes on
    to the next life.

    Args:
        game: the ROM's name in ale-py.
        episode: "life" or "game", see :class:`AtariEnv`.
        frame_cap: emulated frames after which a game is cut (truncated).

    Raises:
        UserError: as :class:`AtariEnv`.

    Examples:
        >>> env = AtariGymEnv("breakout")
        >>> observation, info = env.reset(seed=0)
        >>> observation.shape, info
        ((4, 84, 84), {'lives': 5})
    """

    def __init__(self, game: str, *, episode: Episode = "life", frame_cap: int = FRAME_CAP) -> None:
        self._env = _SeededAsRecorded(game, 1, episode=episode, frame_cap=frame_cap)
        shape = (STACK, SIDE, SIDE)
        self.observation_space = gymnasium.spaces.Box(0, 255, shape, np.uint8)
        self.action_space = gymnasium.spaces.Discrete(int(self._env.action_spec.space.n))

    def get_action_meanings(self) -> list[str]:
        """The actions' names, by ale-py's own name for this method: ``["NOOP", "FIRE", ...]``."""
        return list(self._env.meanings)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """The first observation and ``{"lives": ...}``."""
        super().reset(seed=seed)
        if seed is not None:
            self._env._set_seed(seed)
        return self._env.reset()["observation"][0].numpy(), {"lives": int(self._env.lives[0])}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Observation, unclipped reward, terminated, truncated and ``{"lives": ...}``."""
        after = self._env._step(TensorDict({"action": torch.tensor([int(action)])}, [1]))
        return (
            after["observation"][0].numpy(),
            after["reward"].item(),
            after["terminated"].item(),
            after["truncated"].item(),
            {"lives": int(self._env.lives[0])},
        )

    def close(self) -> None:
        """Ends the emulator."""
        self._env.close(raise_if_closed=False)


class _SeededAsRecorded(AtariEnv):
    """A game whose emulator is seeded by the given seed alone, as in every recording so far."""

    def _episode_seed(self, index: int) -> int:
        entropy = [self._root_seed, index, int(self._episode[index])]
        return int(np.random.SeedSequence(entropy).generate_state(1)[0])
