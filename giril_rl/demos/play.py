"""Play a game by hand, and record it as an expert's demonstration."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import Any, Protocol

import gymnasium
import numpy as np
import torch
from torch import Tensor

from giril_rl.demos.demonstration import Demonstration
from giril_rl.demos.record import record_demonstration
from giril_rl.envs.gym_api import env_name
from giril_rl.errors import UserError

KEYS = {"up": "UP", "down": "DOWN", "left": "LEFT", "right": "RIGHT", "fire": "SPACE"}
"""Directions and the button, with pygame's names of their keys."""
SCALE = 6
FPS = 15
"""An action lasts four of a game's sixty frames a second."""


class Screen(Protocol):
    """Shows a game and reads the keyboard."""

    def show(self, frame: np.ndarray) -> frozenset[str] | None:
        """Draws a grey frame, uint8 [h, w], and waits for the next; the keys of KEYS held down.

        None if the window was closed.
        """

    def close(self) -> None:
        """Ends the window."""


def action_of(keys: frozenset[str], meanings: list[str]) -> int:
    """The action for some keys, in a game whose actions have these names (by ale-py).

    Opposite keys cancel out. If no action fits all keys together, the one that fits most is taken,
    sideways before up and down.

    Examples:
        >>> names = ["NOOP", "FIRE", "RIGHT", "LEFT", "RIGHTFIRE"]
        >>> [action_of(frozenset(keys), names) for keys in ([], ["right", "fire"], ["left", "up"])]
        [0, 4, 3]
    """
    up, side = (
        "".join(name.upper() for name in pair if name in keys)
        for pair in (("up", "down"), ("right", "left"))
    )
    up, side = up.replace("UPDOWN", ""), side.replace("RIGHTLEFT", "")
    fire = "FIRE" if "fire" in keys else ""
    wishes = [(up, side, fire), (side, fire), (up, fire), (up, side), (side,), (up,), (fire,)]
    for wish in wishes:
        if all(wish) and "".join(wish) in meanings:
            return meanings.index("".join(wish))
    return 0


def play_demonstration(
    make_fn: Callable[[], gymnasium.Env],
    screen: Screen,
    *,
    episodes: int,
    seed: int,
    task: str | None = None,
    lives: str | None = None,
) -> Demonstration:
    """Records whole episodes of a human player, checked and replayed as any recording.

    The player sees the latest frame, and plays the keys held down while it is shown.

    Args:
        make_fn: makes a game with images and ``get_action_meanings``.
        screen: shows frames and reads keys; closed at the end.
        episodes: number of episodes.
        seed: root of the episodes' seeds.
        task: the task's name, for the card.
        lives: "first" or "all", for the card.

    Raises:
        UserError: if the window is closed before all episodes are over; nothing is kept then.

    Examples:
        >>> play_demonstration(make_fn, Window("pong"), episodes=1, seed=0)  # doctest: +SKIP
    """
    env = make_fn()
    named = getattr(env.unwrapped, "get_action_meanings", None)
    meanings = named() if named is not None else []
    env.close()
    if not meanings:
        raise UserError(
            f"{env_name(env)} does not name its actions (get_action_meanings): it cannot be played "
            "by hand."
        )

    def choose(observation: Tensor) -> Tensor:
        keys = screen.show(observation[0, -1].numpy())
        if keys is None:
            raise UserError("the window was closed before all episodes were over: none is kept.")
        return torch.tensor([action_of(keys, meanings)])

    try:
        demo = record_demonstration(
            make_fn, choose, seed=seed, episodes=episodes, task=task, lives=lives
        )
    finally:
        screen.close()
    demo.card["deterministic"] = "by hand"
    return demo


class Window:
    """A :class:`Screen` by pygame: arrows, space, Escape to leave.

    Raises:
        UserError: without pygame or a display.
    """

    def __init__(self, title: str) -> None:
        try:
            import pygame
        except ImportError:
            raise UserError(
                'playing needs pygame, which is not installed: pip install "giril-rl[play]".'
            ) from None
        shown = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
        if sys.platform.startswith("linux") and not any(map(os.environ.get, shown)):
            raise UserError("playing needs a screen, and there is no display here: play elsewhere.")
        self._game: Any = pygame
        try:
            pygame.display.init()
            self._window = pygame.display.set_mode((84 * SCALE, 84 * SCALE))
        except pygame.error as error:
            raise UserError(f"playing needs a screen, and none can be opened ({error}).") from None
        pygame.display.set_caption(title)
        self._clock = pygame.time.Clock()
        self._codes = {name: getattr(pygame, f"K_{code}") for name, code in KEYS.items()}

    def show(self, frame: np.ndarray) -> frozenset[str] | None:
        """See :class:`Screen`."""
        colours = np.repeat(
            frame.T[:, :, None], 3, axis=2
        )  # pygame's first dimension is the width.
        surface = self._game.surfarray.make_surface(colours)
        self._game.transform.scale(surface, self._window.get_size(), self._window)
        self._game.display.flip()
        self._clock.tick(FPS)
        leaves = any(event.type == self._game.QUIT for event in self._game.event.get())
        held = self._game.key.get_pressed()
        if leaves or held[self._game.K_ESCAPE]:
            return None
        return frozenset(name for name, code in self._codes.items() if held[code])

    def close(self) -> None:
        """Ends the window."""
        self._game.quit()
