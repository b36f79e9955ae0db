"""What a generative model foresees of single transitions, beside what came, as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase

from giril_rl.rewards import GenerativeReward
from giril_rl.runs.curve import new_figure, save

COLUMNS = ("s", "action", "predicted s'", "true s'", "squared error")
# Inches: what is left of the frames, a frame, the action's name, a gap, what is below a frame.
_LEFT, _SIDE, _ACTION, _GAP, _BELOW = 1.15, 1.35, 1.05, 0.1, 0.3
_TITLE, _HEAD, _GROUP, _BAR = 0.5, 0.25, 0.32, 0.7


@dataclass(frozen=True)
class Shown:
    """Transitions to be shown together.

    Attributes:
        title: where they come from.
        labels: a few words for each.
        observation: the last frame of s, uint8 [n, h, w].
        actions: the actions' names.
        predicted: the last frame of the predicted s', in [-1, 1] if clamped, float32 [n, h, w].
        following: the last frame of the true s', likewise.
        rewards: the reward of each, of all frames, [n].
    """

    title: str
    labels: list[str]
    observation: np.ndarray
    actions: list[str]
    predicted: np.ndarray
    following: np.ndarray
    rewards: list[float]

    @property
    def errors(self) -> np.ndarray:
        """The squared error of the last frame, float32 [n, h, w]."""
        return (self.predicted - self.following) ** 2


def spread(length: int, count: int) -> list[int]:
    """At most ``count`` indices below ``length``, the middles of as many equal stretches.

    Examples:
        >>> spread(100, 4), spread(2, 4)
        ([12, 37, 62, 87], [0, 1])
    """
    count = min(length, count)
    return [(2 * i + 1) * length // (2 * count) for i in range(count)]


@torch.no_grad()
def foresee(
    model: GenerativeReward,
    transitions: TensorDictBase,
    *,
    title: str,
    labels: Sequence[str],
    actions: Sequence[str],
) -> Shown:
    """Looks up what ``model`` foresees of a few transitions.

    Args:
        model: the generative model of frames, in eval mode.
        transitions: ``observation``, ``action`` and ``("next", "observation")``, batch [n].
        title: where the transitions come from.
        labels: a few words for each.
        actions: names of all actions.
    """
    keys = ("observation", "action", ("next", "observation"))
    before, chosen, after = (transitions.get(key) for key in keys)
    noise = model.get_extra_state()
    predicted = model.predict(before, chosen, after)
    model.set_extra_state(noise)  # For beta < 1, the reward is of this very prediction.
    values = model(transitions.select(*keys)).get(model.out_keys[0])
    return Shown(
        title=title,
        labels=list(labels),
        observation=before[:, -1].numpy(),
        actions=[actions[index] for index in chosen.tolist()],
        predicted=predicted[:, -1].numpy(),
        following=model.scaler(after)[:, -1].numpy(),
        rewards=values.flatten().tolist(),
    )


def draw_predictions(groups: Sequence[Shown], title: str, path: Path) -> None:
    """Write the picture: a row for each transition, one scale of the error for all.

    Args:
        groups: transitions under their titles.
        title: the picture's title.
        path: the PNG file.
    """
    rows = sum(len(group.labels) for group in groups)
    width = _LEFT + 4 * _SIDE + _ACTION + 5 * _GAP + 0.05
    height = _TITLE + _HEAD + len(groups) * _GROUP + rows * (_SIDE + _BELOW) + _BAR
    figure = new_figure(width, height)
    figure.set_layout_engine("none")  # Every place is given here, in inches.
    highest = max(float(group.errors.max()) for group in groups) or 1.0
    figure.text(0.5, 1 - 0.25 / height, title, ha="center", va="center", fontsize=11)
    top = height - _TITLE - _HEAD
    for name, left in zip(COLUMNS, _lefts(), strict=True):
        middle = left + (_ACTION if name == "action" else _SIDE) / 2
        figure.text(middle / width, top / height, name, ha="center", va="bottom", fontsize=9)
    image = None
    for group in groups:
        figure.text(
            _GAP / width, (top - 0.17) / height, group.title, va="center", weight="bold", fontsize=9
        )
        top -= _GROUP
        for index in range(len(group.labels)):
            image = _row(figure, group, index, top - _SIDE, highest)
            top -= _SIDE + _BELOW
    axes = figure.add_axes((0.25, 0.42 / height, 0.5, 0.12 / height))
    bar = figure.colorbar(image, cax=axes, orientation="horizontal")
    bar.set_label("squared error of a pixel, frames in [-1, 1]", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    save(figure, path)


def _short(value: float) -> str:
    return f"{value:,.1f}" if abs(value) >= 10 else f"{value:.3g}"


def _lefts() -> list[float]:
    first, step = _LEFT + _GAP, _SIDE + _GAP
    action = first + step
    after = action + _ACTION + _GAP
    return [first, action, *(after + i * step for i in range(3))]


def _row(figure: Any, group: Shown, index: int, bottom: float, highest: float) -> Any:
    """Draws one transition; the error's image, for the colour bar."""
    width, height = figure.get_size_inches()
    middle = (bottom + _SIDE / 2) / height
    lefts = _lefts()
    figure.text(_GAP / width, middle, group.labels[index], va="center", fontsize=9)
    figure.text(
        (lefts[1] + _ACTION / 2) / width,
        middle,
        group.actions[index],
        ha="center",
        va="center",
        fontsize=8,
    )
    image = None
    for left, values, colours, limits in (
        (lefts[0], group.observation[index], "gray", (0, 255)),
        (lefts[2], group.predicted[index], "gray", (-1, 1)),
        (lefts[3], group.following[index], "gray", (-1, 1)),
        (lefts[4], group.errors[index], "magma", (0, highest)),
    ):
        axes = figure.add_axes((left / width, bottom / height, _SIDE / width, _SIDE / height))
        low, high = limits
        image = axes.imshow(values, cmap=colours, vmin=low, vmax=high, interpolation="nearest")
        axes.set_xticks([])
        axes.set_yticks([])
    figure.text(
        (lefts[4] + _SIDE / 2) / width,
        (bottom - 0.05) / height,
        f"reward {_short(group.rewards[index])}",
        ha="center",
        va="top",
        fontsize=8,
    )
    return image
