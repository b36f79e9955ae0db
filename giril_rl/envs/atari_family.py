"""The family of Atari games, and a game as the Gymnasium environment of demonstrations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict

from giril_rl.config.schema import TaskConfig
from giril_rl.envs.atari import STACK, AtariEnv, Episode
from giril_rl.envs.atari_preprocessing import FRAME_CAP, SIDE, SKIP
from giril_rl.envs.batched import BatchedEnv
from giril_rl.envs.gym_api import import_package, registered_spec
from giril_rl.runs.randomness import Use


def gym_factory(task: TaskConfig) -> Callable[[], gymnasium.Env]:
    """See :func:`giril_rl.envs.gym_factory`."""
    arguments = _arguments(task)

    def make_one() -> gymnasium.Env:
        env = AtariGymEnv(**arguments)
        env.spec = registered_spec(task.env_id)
        return env

    return make_one


def make(task: TaskConfig, num_envs: int, seed: int, use: Use) -> BatchedEnv:
    """See :func:`giril_rl.envs.make_env`."""
    return AtariEnv(num_envs=num_envs, seed=seed, use=use, **_arguments(task))


def _arguments(task: TaskConfig) -> dict[str, Any]:
    import_package("ale_py", extra="atari")  # Registers the ids.
    steps = task.max_episode_steps
    return {
        "game": str(registered_spec(task.env_id).kwargs["game"]),
        "episode": cast(Episode, task.episode),
        "frame_cap": FRAME_CAP if steps is None else SKIP * steps,
    }


class AtariGymEnv(gymnasium.Env):
    """One game of :class:`AtariEnv` in Gymnasium's terms, to record and replay demonstrations in.

    A reset with a seed begins the game of that seed. A reset without one after a lost life
    continues with the next life.

    Args:
        game: the ROM's name in ale-py.
        episode: "life" or "game", see :class:`AtariEnv`.
        frame_cap: emulated frames after which a game is truncated.

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
        """The actions' names, ``["NOOP", "FIRE", ...]``; the method is named as in ale-py."""
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
