"""One game of a trained policy, as the reward model sees it in training."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from giril_rl.config.schema import TaskConfig
from giril_rl.envs import AtariEnv, make_env
from giril_rl.runs.randomness import seeded
from giril_rl.training.scoring import Player

MOST_STEPS = 2_000
GAMES = 5
"""Games that a typical one is chosen from."""


@dataclass(frozen=True)
class Game:
    """What happened in a game of N steps.

    Attributes:
        transitions: ``observation``, ``action`` and ``("next", "observation")``, batch [N].
        score: the score after each step, float64 [N].
        lives: lives left after each step, int64 [N].
        first_lives: lives at the start.
        actions: the names of the actions.
        whole: whether the game ended, rather than being cut.
    """

    transitions: TensorDict
    score: np.ndarray
    lives: np.ndarray
    first_lives: int
    actions: list[str]
    whole: bool

    @property
    def lost(self) -> np.ndarray:
        """The steps, counted from 1, in which a life was lost, int64.

        Examples:
            >>> lives, none = np.array([3, 2, 2, 0]), TensorDict({}, [4])
            >>> Game(none, np.zeros(4), lives, 3, [], True).lost.tolist()
            [2, 4]
        """
        return np.flatnonzero(np.diff(self.lives, prepend=self.first_lives) < 0) + 1


def play_game(agent: Player, task: TaskConfig, *, seed: int, most: int = MOST_STEPS) -> Game:
    """Plays one game with sampled actions, through all lives.

    Where a lost life ends an episode of training, the transition in which it is lost ends in that
    life's last frames, as in training. Torch's random state is put back.

    Args:
        agent: the policy.
        task: an Atari task.
        seed: seed of the game and of the actions.
        most: steps after which the game is cut.

    Raises:
        UserError: if ale-py is not installed.
    """
    env = cast(AtariEnv, make_env(task, 1, seed))
    policy = agent.acting()
    played: list[TensorDictBase] = []
    score, lives = [], []
    with (
        seeded(seed),
        torch.no_grad(),
        set_exploration_type(ExplorationType.RANDOM),
    ):
        batch = env.reset()
        first_lives, over = int(env.lives[0]), False
        while not over and len(played) < most:
            batch = env.step(policy(batch))
            played.append(batch.select("observation", "action", ("next", "observation")))
            score.append(batch["next", "reward"].item())
            lives.append(int(env.lives[0]))
            over = bool(batch["next", "game_over"].item())
            if not over:
                batch = env.maybe_reset(step_mdp(batch))
    env.close()
    return Game(
        transitions=cast(TensorDict, torch.cat(played)),
        score=np.cumsum(score, dtype=np.float64),
        lives=np.array(lives, dtype=np.int64),
        first_lives=first_lives,
        actions=env.meanings,
        whole=over,
    )


def typical_game(
    agent: Player, task: TaskConfig, *, seed: int, most: int = MOST_STEPS
) -> tuple[Game, int]:
    """Of five games, with the seeds from ``seed`` on, the one of median score, and its seed.

    One game alone may be one in which nothing happens. See :func:`play_game` for the rest.
    """
    scores = {
        own: play_game(agent, task, seed=own, most=most).score[-1]
        for own in range(seed, seed + GAMES)
    }
    median = sorted(scores, key=lambda own: scores[own])[GAMES // 2]
    return play_game(agent, task, seed=median, most=most), median
