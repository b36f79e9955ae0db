"""One Atari game of a trained policy: played, rewarded and drawn."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from giril_rl.config.schema import TaskConfig
from giril_rl.envs import AtariEnv, make_env
from giril_rl.rewards.method import BLACK, BLUE, GREY, RED
from giril_rl.runs.curve import new_figure, save, thousands
from giril_rl.runs.randomness import seeded
from giril_rl.training.scoring import Player

MOST_STEPS = 2_000
GAMES = 5
"""Games from which the typical one is chosen."""


@dataclass(frozen=True)
class Game:
    """A game of N steps.

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

    If training episodes end with a life, the transition in which it is lost ends in that life's
    last frames, as in training. Torch's random state is restored. The game is cut after ``most``
    steps.

    Raises:
        UserError: if ale-py is not installed.
    """
    env = cast(AtariEnv, make_env(task, 1, seed))
    policy = agent.acting()
    played: list[TensorDictBase] = []
    score, lives = [], []
    with seeded(seed), torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
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
    """The game of median score of five, and its seed; see :func:`play_game`.

    The five games have the seeds from ``seed`` on. In a single game nothing may happen.
    """
    scores = {
        own: play_game(agent, task, seed=own, most=most).score[-1]
        for own in range(seed, seed + GAMES)
    }
    median = sorted(scores, key=lambda own: scores[own])[GAMES // 2]
    return play_game(agent, task, seed=median, most=most), median


@torch.no_grad()
def rewards_of(reward: TensorDictModuleBase, transitions: TensorDictBase) -> np.ndarray:
    """The module's reward of each of N transitions, neither scaled nor averaged: float32 [N]."""
    return reward(transitions.select(*reward.in_keys)).get(reward.out_keys[0]).flatten().numpy()


def draw_game(
    rewards: np.ndarray, game: Game, title: str, path: Path, demonstration: float | None = None
) -> None:
    """Write the PNG: the reward of each step, the same in detail, score and lives.

    A life begins with an empty stack of frames, which a model predicts badly. The detail leaves out
    the steps before the stack is full, beside which all others look alike. ``demonstration`` is the
    mean reward of the demonstration's transitions.
    """
    figure = new_figure(9, 7)
    upper, detail, lower = figure.subplots(3, 1, sharex=True)
    steps = np.arange(1, len(rewards) + 1)
    is_full = game.transitions["observation"][:, 0].flatten(1).any(1).numpy()
    upper.plot(steps, rewards, color=BLUE, linewidth=0.9, label="reward of a step")
    if demonstration is not None:
        label = "mean over the demonstration"
        upper.axhline(demonstration, color=GREY, linestyle="--", label=label)
    detail.plot(steps, np.where(is_full, rewards, np.nan), color=BLUE, linewidth=0.9)
    for axes in (upper, detail, lower):
        for number, step in enumerate(game.lost):
            lost = None if number else "a life is lost"
            axes.axvline(step, color=RED, linestyle=":", linewidth=1.3, label=lost, zorder=1)
        axes.grid(alpha=0.3)
        thousands(axes.yaxis)
    upper.set_ylabel("reward")
    upper.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, fontsize=8, frameon=False)
    detail.set_ylabel("reward,\nstack of frames full")
    _score_and_lives(lower, game)
    figure.suptitle(title, fontsize=11)
    save(figure, path)


def _score_and_lives(axes: Any, game: Game) -> None:
    length = len(game.lives)
    from_start = np.arange(length + 1)
    axes.step(from_start, np.append(0.0, game.score), where="post", color=BLACK)
    low, high = min(0.0, game.score.min()), max(1.0, game.score.max())
    axes.set_ylim(low - 0.05 * (high - low), high + 0.08 * (high - low))
    axes.yaxis.get_major_locator().set_params(integer=True)
    axes.set_ylabel("score so far")
    lives = axes.twinx()
    lives.step(from_start, np.append(game.first_lives, game.lives), where="post", color=RED)
    lives.set_ylabel("lives", color=RED)
    most = max(game.first_lives, int(game.lives.max()), 1)
    lives.set_ylim(-0.05 * most, 1.08 * most)
    lives.yaxis.get_major_locator().set_params(integer=True)
    axes.set_xlabel("step of the game")
    thousands(axes.xaxis)
    axes.set_xlim(0, 1.01 * length)  # Leaves room for the result of the last step.
