"""Pictures of generative rewards on Atari: predictions of transitions, and the reward of a game."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase

from giril_rl.config.schema import DemoConfig
from giril_rl.demos import Demonstration
from giril_rl.errors import UserError
from giril_rl.experiments.report.entries import entry
from giril_rl.experiments.report.game import (
    GAMES,
    MOST_STEPS,
    draw_game,
    rewards_of,
    typical_game,
)
from giril_rl.experiments.report.reading import RunRecord
from giril_rl.experiments.report.rows import Panel, Row
from giril_rl.files.disk import read_json
from giril_rl.policies import load_agent
from giril_rl.rewards import GenerativeConfig, GenerativeReward
from giril_rl.runs.curve import new_figure, save
from giril_rl.runs.finished import read_config, read_part, read_settings
from giril_rl.runs.identity import safe
from giril_rl.runs.pretrained import CARD
from giril_rl.training.demonstrations import find_demonstration
from giril_rl.training.result import REWARD

EACH = 4
"""Transitions of the demonstration, and of the policy."""
MOST_STEPS_SAMPLED = 300
"""Steps of a game if beta < 1: each reward then takes a pass through the whole networks."""
COLUMNS = ("s", "action", "predicted s'", "true s'", "squared error")
# Inches: left of the frames, a frame, the action's name, a gap, below a frame.
_LEFT, _SIDE, _ACTION, _GAP, _BELOW = 1.15, 1.35, 1.05, 0.1, 0.3
_TITLE, _HEAD, _GROUP, _BAR = 0.5, 0.25, 0.32, 0.7


def draw_pictures(panels: Sequence[Panel], out: Path) -> list[str]:
    """Draw predictions and a game's reward for each row of generative rewards on Atari.

    A row's run is the one with the lowest seed. Nothing is trained or recorded: a run that lacks a
    file is named with the reason, and a run without its demonstration has pictures of its policy.
    Returns a section of Markdown for each Atari task with such runs.
    """
    sections = []
    for panel in panels:
        rows = [row for row in panel.rows if _is_game(row) and is_generative(row)]
        if rows:
            sections.append(_section(panel, rows, out))
    return sections


def _is_game(row: Row) -> bool:
    family = row.runs[0].family
    return family.has_lives and family.observation == "image"


def is_generative(row: Row) -> bool:
    """Whether a row's reward is a generative model's error, by the card of its saved reward.

    Without a readable card the registry tells, and loading the reward tells what is wrong.
    """
    try:
        made_by = read_json(row.runs[0].folder / REWARD / CARD).get("made_by")
    except UserError:
        return row.about.settings is GenerativeConfig
    return isinstance(made_by, dict) and made_by.get("class") == GenerativeReward.__name__


def _section(panel: Panel, rows: Sequence[Row], out: Path) -> str:
    text, missing = [], defaultdict(list)
    for row in rows:
        run = row.runs[0]
        try:
            text.append(_pictures(panel, row, run, out))
        except UserError as error:
            reason = str(error).replace(f"{run.folder}/", "its ").replace(str(run.folder), "it")
            missing[reason].append(f"`{run.name}`")
    if text:
        text.insert(0, _EXPLAINED)
    text += [f"No pictures of {', '.join(names)}: {why}\n" for why, names in missing.items()]
    return "\n".join([f"## {panel.title}: pictures\n", *text])


_EXPLAINED = (
    "Of each row above, the run with the lowest seed. Predictions: the last of the four frames of "
    "s, of the predicted s' and of the true s', and the squared error of that frame; "
    "the reward is of all four frames, before any averaging and scaling. "
    "Transitions are evenly spread in time. Along a game: the same reward, step by step, and "
    "dashed its mean over the demonstration; below, without the steps that begin a life, while "
    "the stack is not yet full of frames. The policy samples its actions; of "
    f"{GAMES} games the one of median score is shown. The picture ends "
    f"after {MOST_STEPS:,} steps, where beta is below 1 after {MOST_STEPS_SAMPLED:,}.\n"
)


def _pictures(panel: Panel, row: Row, run: RunRecord, out: Path) -> str:
    """Draws a run's two pictures and returns their Markdown."""
    task, scoring = read_settings(run.folder)
    model = GenerativeReward.from_pretrained(run.folder / REWARD)
    demo = find_demonstration(run.folder, run.below)
    most = MOST_STEPS if model.beta == 1 else MOST_STEPS_SAMPLED
    game, seed = typical_game(load_agent(run.folder, task), task, seed=scoring.seed, most=most)
    length = f"{len(game.lives):,} steps"
    played = f"a whole game of {length}" if game.whole else f"the first {length} of a game"

    indices = spread(len(game.lives), EACH)
    policy = predict(
        model,
        game.transitions[indices],
        title=f"trained policy, {played}",
        labels=[f"step {index + 1:,}" for index in indices],
        actions=game.actions,
    )
    groups, usual = [policy], None
    if demo is not None:
        groups.insert(0, _of_demonstration(run, demo, model, game.actions))
        usual = rewards_of(model, demo.transitions[spread(len(demo), most)]).mean().item()
    about = f"{row.name}, seed {run.seed}, {run.steps:,} steps"
    title = f"{panel.title}: {about}"
    words = [panel.title.replace(", ", "-"), row.method, row.profile or ""]
    words += [row.settings.replace(" ", ","), f"{run.steps}", f"seed{run.seed}"]
    name = f"{safe('-'.join(filter(None, words)))}.png"
    draw_predictions(groups, title, out / f"predictions-{name}")
    draw_game(rewards_of(model, game.transitions), game, title, out / f"reward-{name}", usual)
    settings = f" `{row.settings}`" if row.settings else ""
    without = "" if demo is not None else f" {_NO_DEMONSTRATION}"
    return (
        f"{about}{settings}: `{run.name}`; {played}, seed {seed}.{without}\n\n"
        f"![predictions, {about}](predictions-{name})\n\n"
        f"![reward along a game, {about}](reward-{name})\n"
    )


_NO_DEMONSTRATION = (
    "Its demonstration is not in the folder reported on, so all transitions are the policy's."
)


@dataclass(frozen=True)
class Predictions:
    """Transitions that are shown together.

    Attributes:
        title: where they come from.
        labels: a few words for each.
        observation: the last frame of s, uint8 [n, h, w].
        actions: the actions' names.
        predicted: the last frame of the predicted s', in [-1, 1] if clamped, float32 [n, h, w].
        next_observation: the last frame of the true s', likewise.
        rewards: the reward of each, of all frames, [n].
    """

    title: str
    labels: list[str]
    observation: np.ndarray
    actions: list[str]
    predicted: np.ndarray
    next_observation: np.ndarray
    rewards: list[float]

    @property
    def errors(self) -> np.ndarray:
        """The squared error of the last frame, float32 [n, h, w]."""
        return (self.predicted - self.next_observation) ** 2


def spread(length: int, count: int) -> list[int]:
    """At most ``count`` indices below ``length``: the middles of equal intervals.

    Examples:
        >>> spread(100, 4), spread(2, 4)
        ([12, 37, 62, 87], [0, 1])
    """
    count = min(length, count)
    return [(2 * i + 1) * length // (2 * count) for i in range(count)]


@torch.no_grad()
def predict(
    model: GenerativeReward,
    transitions: TensorDictBase,
    *,
    title: str,
    labels: Sequence[str],
    actions: Sequence[str],
) -> Predictions:
    """Predictions of a few transitions by a model of frames in eval mode.

    ``actions`` are the names of all actions; see :class:`Predictions` for the rest.
    """
    keys = ("observation", "action", ("next", "observation"))
    before, chosen, after = (transitions.get(key) for key in keys)
    noise = model.get_extra_state()
    predicted = model.predict(before, chosen, after)
    model.set_extra_state(noise)  # If beta < 1, the reward is of this very prediction.
    return Predictions(
        title=title,
        labels=list(labels),
        observation=before[:, -1].numpy(),
        actions=[actions[index] for index in chosen.tolist()],
        predicted=predicted[:, -1].numpy(),
        next_observation=model.scaler(after)[:, -1].numpy(),
        rewards=rewards_of(model, transitions).tolist(),
    )


def _of_demonstration(
    run: RunRecord, demo: Demonstration, model: GenerativeReward, actions: Sequence[str]
) -> Predictions:
    indices = spread(len(demo), EACH)
    some = demo.transitions[indices]
    labels = [f"step {step + 1:,}" for step in some["step"].tolist()]
    if demo.num_episodes > 1:
        episodes = some["episode"].tolist()
        labels = [f"game {e + 1}\n{label}" for e, label in zip(episodes, labels, strict=True)]
    title = f"demonstration, {len(demo):,} transitions"
    every = read_part(run.folder, read_config(run.folder), "demo", DemoConfig).subsample
    if entry(run.method).trained != "never" and every > 1:
        title += f", of which the model was trained on 1 in {every}"
        labels = [
            f"{label}\n{'not ' if index % every else ''}trained on"
            for index, label in zip(indices, labels, strict=True)
        ]
    return predict(model, some, title=title, labels=labels, actions=actions)


def draw_predictions(groups: Sequence[Predictions], title: str, path: Path) -> None:
    """Write the PNG: a row for each transition, with one colour scale for all errors."""
    rows = sum(len(group.labels) for group in groups)
    width = _LEFT + 4 * _SIDE + _ACTION + 5 * _GAP + 0.05
    height = _TITLE + _HEAD + len(groups) * _GROUP + rows * (_SIDE + _BELOW) + _BAR
    figure = new_figure(width, height)
    figure.set_layout_engine("none")  # All positions are given here, in inches.

    def write(x: float, y: float, words: str, **how: Any) -> None:
        figure.text(x / width, y / height, words, **how)

    highest = max(float(group.errors.max()) for group in groups) or 1.0
    write(width / 2, height - 0.25, title, ha="center", va="center", fontsize=11)
    top = height - _TITLE - _HEAD
    for name, left in zip(COLUMNS, _lefts(), strict=True):
        middle = left + (_ACTION if name == "action" else _SIDE) / 2
        write(middle, top, name, ha="center", va="bottom", fontsize=9)
    image = None
    for group in groups:
        write(_GAP, top - 0.17, group.title, va="center", weight="bold", fontsize=9)
        top -= _GROUP
        for index in range(len(group.labels)):
            image = _row(figure, write, group, index, top - _SIDE, highest)
            top -= _SIDE + _BELOW
    axes = figure.add_axes((0.25, 0.42 / height, 0.5, 0.12 / height))
    bar = figure.colorbar(image, cax=axes, orientation="horizontal")
    bar.set_label("squared error of a pixel, frames in [-1, 1]", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    save(figure, path)


def _lefts() -> list[float]:
    first, step = _LEFT + _GAP, _SIDE + _GAP
    action = first + step
    after = action + _ACTION + _GAP
    return [first, action, *(after + i * step for i in range(3))]


def _row(
    figure: Any, write: Any, group: Predictions, index: int, bottom: float, highest: float
) -> Any:
    """Draws one transition and returns the error's image, for the colour bar."""
    width, height = figure.get_size_inches()
    lefts, middle = _lefts(), bottom + _SIDE / 2
    write(_GAP, middle, group.labels[index], va="center", fontsize=9)
    action = lefts[1] + _ACTION / 2
    write(action, middle, group.actions[index], ha="center", va="center", fontsize=8)
    image = None
    for left, values, colours, limits in (
        (lefts[0], group.observation[index], "gray", (0, 255)),
        (lefts[2], group.predicted[index], "gray", (-1, 1)),
        (lefts[3], group.next_observation[index], "gray", (-1, 1)),
        (lefts[4], group.errors[index], "magma", (0, highest)),
    ):
        axes = figure.add_axes((left / width, bottom / height, _SIDE / width, _SIDE / height))
        low, high = limits
        image = axes.imshow(values, cmap=colours, vmin=low, vmax=high, interpolation="nearest")
        axes.set_xticks([])
        axes.set_yticks([])
    reward = group.rewards[index]
    text = f"reward {reward:,.1f}" if abs(reward) >= 10 else f"reward {reward:.3g}"
    write(lefts[4] + _SIDE / 2, bottom - 0.05, text, ha="center", va="top", fontsize=8)
    return image
