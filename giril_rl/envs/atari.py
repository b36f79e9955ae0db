"""Atari games as one TorchRL environment: frame stacks, and lives or whole games as episodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Categorical

from giril_rl.envs.atari_preprocessing import FRAME_CAP, NOOP, SIDE, SKIP, AtariGame, Shown
from giril_rl.envs.batched import (
    BatchedEnv,
    check_counts,
    saved_array,
    saved_seed,
    saved_tensor,
)
from giril_rl.errors import UserError
from giril_rl.runs.randomness import Use

Episode = Literal["life", "game"]

STACK = 4
RESEED_EVERY = 64
"""Games per seed: seeding takes ten times as long as the rest of a reset."""


class Opened(NamedTuple):
    """What the opening steps of lives did, for each game."""

    scored: np.ndarray
    over: np.ndarray
    cut: np.ndarray


class AtariEnv(BatchedEnv):
    """``num_envs`` Atari games with DeepMind's preprocessing and four stacked frames.

    :class:`~giril_rl.envs.atari_preprocessing.AtariGame` makes the frames. Observations are uint8
    ``(num_envs, 4, 84, 84)``, the latest frame last; actions are integers.

    With ``episode="life"`` a lost life ends the episode (``terminated``) and the game continues;
    ``("next", "observation")`` is then the last stack of that life. With ``episode="game"``, as
    scores are counted, only the game's end does; where a life is lost in the middle,
    ``("next", "observation")`` is the first stack of the next life. In either mode
    ``("next", "game_over")`` marks the end of a game, ``("next", "life_over")`` that of a life.

    A life begins as in the wrappers of OpenAI baselines: with a step without action (except a
    game's first life) and, in games that have the button, the actions 1 (fire) and 2. The stack is
    then black but for the latest frame. Rewards during an opening count in the game's score (except
    the first opening's) but are not shown to the learner of single lives.

    Each emulator is seeded at every 64th game. Games differ in how many frames without action
    they begin with.

    Args:
        game: the ROM's name in ale-py, such as ``"breakout"``.
        num_envs: number of games.
        episode: "life" or "game".
        seed: root of the games' seeds.
        use: what the episodes are for; two uses never share seeds.
        frame_cap: emulated frames after which a game is truncated.

    Raises:
        UserError: if ale-py is not installed or has no such game.

    Examples:
        >>> env = AtariEnv("breakout", num_envs=2)
        >>> batch = env.rollout(5)
        >>> batch["next", "observation"].shape, batch["next", "observation"].dtype
        (torch.Size([2, 5, 4, 84, 84]), torch.uint8)
    """

    has_threads = True

    def __init__(
        self,
        game: str,
        num_envs: int,
        *,
        episode: Episode = "life",
        seed: int = 0,
        use: Use = "training",
        frame_cap: int = FRAME_CAP,
    ) -> None:
        if episode not in ("life", "game"):
            raise UserError(f"task.episode={episode}: choose one of life, game.")
        super().__init__(num_envs, seed=seed, use=use)
        self._games = [AtariGame(game, frame_cap) for _ in range(num_envs)]
        self._longest = -(-frame_cap // SKIP)
        self._lives_end = episode == "life"
        self._opening = [1, 2] if self._games[0].fires else []
        self._lives = np.zeros(num_envs, dtype=np.int64)
        self._between = np.zeros(num_envs, dtype=bool)  # A life was lost and the game continues.
        self._actions: list[list[int]] = [[] for _ in range(num_envs)]  # Since a game's reset.
        self._last_observation = np.zeros((num_envs, STACK, SIDE, SIDE), dtype=np.uint8)
        shape = (num_envs, STACK, SIDE, SIDE)
        self._declare(
            Bounded(0, 255, shape=shape, dtype=torch.uint8),
            Categorical(len(self._games[0].meanings), shape=(num_envs,), dtype=torch.int64),
        )
        for key in ("game_over", "life_over"):
            self.observation_spec[key] = Categorical(2, shape=(num_envs, 1), dtype=torch.bool)

    @property
    def lives(self) -> np.ndarray:
        """Lives left in each game, int64 ``(num_envs,)``."""
        return self._lives.copy()

    @property
    def meanings(self) -> list[str]:
        """Names of the actions, in order."""
        return self._games[0].meanings

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        everyone = range(len(self._games))
        shown = self._play(everyone, tensordict.get("action").tolist())
        stack = np.empty_like(self._last_observation)
        stack[:, :-1] = self._last_observation[:, 1:]
        for i, game in enumerate(shown):
            stack[i, -1] = game.frame
        self._last_observation = stack
        reward = np.array([game.reward for game in shown], dtype=np.float32)
        over = np.array([game.over for game in shown])
        cut = np.array([game.cut for game in shown]) & ~over
        lives = np.array([game.lives for game in shown], dtype=np.int64)
        # In some games (Qbert) the last life is lost some steps before the game is over.
        lost = self._between = (lives < self._lives) & (lives > 0) & ~over & ~cut
        self._lives = lives
        terminated = over | self._between if self._lives_end else over
        if not self._lives_end and self._between.any():
            opened = self._begin_lives(np.flatnonzero(self._between).tolist())
            reward += opened.scored
            over = terminated = over | opened.over
            cut |= opened.cut
            self._between = np.zeros_like(lost)
        return TensorDict(
            {
                "observation": torch.from_numpy(self._last_observation),
                "reward": torch.from_numpy(reward).unsqueeze(-1),
                "done": torch.from_numpy(terminated | cut).unsqueeze(-1),
                "terminated": torch.from_numpy(terminated).unsqueeze(-1),
                "truncated": torch.from_numpy(cut).unsqueeze(-1),
                "game_over": torch.from_numpy(over | cut).unsqueeze(-1),
                "life_over": torch.from_numpy(lost | over | cut).unsqueeze(-1),
            },
            batch_size=self.batch_size,
        )

    def _play(self, indices: Sequence[int], actions: Sequence[int]) -> list[Shown]:
        """One step of some games, at the same time."""
        for i, action in zip(indices, actions, strict=True):
            self._games[i].send(action)
            self._actions[i].append(action)
        return [self._games[i].receive() for i in indices]

    def _root(self, observation: torch.Tensor) -> TensorDictBase:
        root = super()._root(observation)
        return root.set("game_over", self._false).set("life_over", self._false)

    def _reset_where(self, mask: np.ndarray) -> np.ndarray:
        opened = self._begin_lives(np.flatnonzero(mask & self._between).tolist())
        fresh = mask & ~self._between | opened.over | opened.cut
        while fresh.any():  # An opening may end its game, though hardly ever.
            opened = self._begin_games(np.flatnonzero(fresh).tolist())
            fresh = opened.over | opened.cut
        self._between[mask] = False
        return self._last_observation

    def _begin_games(self, indices: list[int]) -> Opened:
        frames = {}
        for i in indices:
            frames[i], self._lives[i] = self._next_game(i)
        return self._open(indices, self._opening, frames)

    def _next_game(self, i: int) -> tuple[np.ndarray, int]:
        fresh = self._episode[i] % RESEED_EVERY == 0
        shown = self._games[i].reset(self._episode_seed(i) if fresh else None)
        self._episode[i] += 1
        self._actions[i] = []
        return shown

    def _begin_lives(self, indices: list[int]) -> Opened:
        return self._open(indices, [NOOP, *self._opening], {})

    def _open(
        self, indices: list[int], actions: list[int], frames: dict[int, np.ndarray]
    ) -> Opened:
        """Plays ``actions`` in some games, then clears their stacks but for the latest frame."""
        scored = np.zeros(len(self._games), dtype=np.float32)
        over, cut = (np.zeros(len(self._games), dtype=bool) for _ in range(2))
        playing = list(indices)
        for action in actions:
            for i, shown in zip(playing, self._play(playing, [action] * len(playing)), strict=True):
                frames[i], self._lives[i] = shown.frame, shown.lives
                scored[i] += shown.reward
                over[i], cut[i] = shown.over, shown.cut and not shown.over
            playing = [i for i in playing if not (over[i] or cut[i])]
        # A batch may still hold the observations returned before.
        self._last_observation = self._last_observation.copy()
        self._last_observation[indices] = 0
        for i in indices:
            self._last_observation[i, -1] = frames[i]
        return Opened(scored, over, cut)

    def _set_seed(self, seed: int | None) -> None:
        super()._set_seed(seed)
        self._between[:] = False

    def simulator_state(self) -> dict[str, Any]:
        """See :meth:`BatchedEnv.simulator_state`.

        Returns:
            Tensors and the seed: the games' numbers, the actions since each game began, int16
            ``(num_envs, longest)`` with -1 after the last, lives and observations.
        """
        longest = max(len(actions) for actions in self._actions)
        actions = np.full((len(self._games), longest), -1, dtype=np.int16)
        for row, own in zip(actions, self._actions, strict=True):
            row[: len(own)] = own
        return {
            "seed": self._root_seed,
            "episode": torch.from_numpy(self._episode.copy()),
            "actions": torch.from_numpy(actions),
            "lives": torch.from_numpy(self._lives.copy()),
            "between": torch.from_numpy(self._between.copy()),
            "observation": torch.from_numpy(self._last_observation.copy()),
        }

    def restore_simulator(self, state: dict[str, Any]) -> bool:
        """See :meth:`BatchedEnv.restore_simulator`.

        A replay fails where another version of ale-py or giril_rl saved the state.
        """
        seed = saved_seed(state)
        episode = saved_array(state, "episode", self._episode)
        between = saved_array(state, "between", self._between)
        saved_lives = saved_array(state, "lives", self._lives)
        observation = saved_array(state, "observation", self._last_observation)
        actions = saved_tensor(state, "actions")
        check_counts("episode", episode, 1)
        _check_actions(actions, len(self._games), len(self.meanings), self._longest)
        self._root_seed, self._episode, self._between = seed, episode, between
        self._lives, self._last_observation = saved_lives, observation
        self._restored = True
        if self._replay(actions):
            return True
        self._between[:] = False
        self._reset_where(np.ones_like(self._between))
        return False

    def _replay(self, actions: np.ndarray) -> bool:
        """Whether the running games, replayed, show the saved frames and lives."""
        frames, lives = np.zeros_like(self._last_observation[:, -1]), np.zeros_like(self._lives)
        over = np.zeros_like(self._between)
        for i, begun in enumerate(self._episode.tolist()):
            self._episode[i] = (begun - 1) // RESEED_EVERY * RESEED_EVERY
            while self._episode[i] < begun:
                frames[i], lives[i] = self._next_game(i)
        for column in actions.T:
            if over[column >= 0].any():
                return False
            playing = np.flatnonzero(column >= 0).tolist()
            for i, shown in zip(
                playing, self._play(playing, column[playing].tolist()), strict=True
            ):
                frames[i], lives[i], over[i] = shown.frame, shown.lives, shown.over or shown.cut
        return np.array_equal(frames, self._last_observation[:, -1]) and np.array_equal(
            lives, self._lives
        )


def _check_actions(actions: np.ndarray, games: int, count: int, longest: int) -> None:
    """Refuses a saved history that games cannot have had; for some, ale-py would wait forever."""
    if actions.dtype != np.int16 or actions.ndim != 2 or len(actions) != games:
        raise ValueError(f"its actions are not int16 of shape [{games}, time]")
    if actions.shape[1] > longest:
        raise ValueError(f"its actions are more than the {longest:,} steps of the longest game")
    ended = actions == -1
    resumed = ended[:, :-1] & ~ended[:, 1:]
    if (actions < -1).any() or (actions >= count).any() or resumed.any():
        raise ValueError(f"its actions are not between 0 and {count - 1}, with -1 after the last")
