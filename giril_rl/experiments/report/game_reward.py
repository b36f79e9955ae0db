"""The reward along one game, with its score and lives, as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from giril_rl.experiments.report.game import Game
from giril_rl.experiments.report.style import BLACK, BLUE, GREY, RED
from giril_rl.runs.curve import new_figure, save, thousands


@torch.no_grad()
def rewards_of(reward: TensorDictModuleBase, transitions: TensorDictBase) -> np.ndarray:
    """The reward of each transition, as the module has it: not scaled, not averaged.

    Args:
        reward: the reward.
        transitions: what it reads, batch [N].

    Returns:
        float32 [N].
    """
    return reward(transitions.select(*reward.in_keys)).get(reward.out_keys[0]).flatten().numpy()


def draw_game(
    rewards: np.ndarray, game: Game, title: str, path: Path, demonstration: float | None = None
) -> None:
    """Write the picture: the reward of each step, the same in detail, score and lives.

    A life begins with an empty stack of frames, which no model foresees well. The second part
    leaves out the steps before the stack is full, next to which all others look the same.

    Args:
        rewards: what :func:`rewards_of` returned.
        game: the game.
        title: the picture's title.
        path: the PNG file.
        demonstration: mean reward of the demonstration's transitions, drawn as a line.
    """
    figure = new_figure(9, 7)
    upper, detail, lower = figure.subplots(3, 1, sharex=True)
    steps = np.arange(1, len(rewards) + 1)
    is_full = game.transitions["observation"][:, 0].flatten(1).any(1).numpy()
    upper.plot(steps, rewards, color=BLUE, linewidth=0.9, label="reward of a step")
    if demonstration is not None:
        upper.axhline(
            demonstration, color=GREY, linestyle="--", label="mean over the demonstration"
        )
    detail.plot(steps, np.where(is_full, rewards, np.nan), color=BLUE, linewidth=0.9)
    for axes in (upper, detail, lower):
        for number, step in enumerate(game.lost):
            label = None if number else "a life is lost"
            axes.axvline(step, color=RED, linestyle=":", linewidth=1.3, label=label, zorder=1)
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
    axes.set_xlim(0, 1.01 * length)  # What the last step led to is seen.
