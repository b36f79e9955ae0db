"""Atari preprocessing: one game as 84 x 84 grey frames of four emulated frames each.

The emulator, ``ale_py``, skips frames, takes their maximum, and makes them grey and 84 x 84: these
are its defaults. Four such frames are stacked in :mod:`giril_rl.envs.atari`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from giril_rl.config.nearest import did_you_mean
from giril_rl.errors import UserError

SIDE = 84
NOOP = 0
SKIP = 4
"""Frames for which an action is repeated."""
FRAME_CAP = 108_000
"""Emulated frames after which a game is cut: half an hour of play, as in DeepMind's evaluation."""


class Shown(NamedTuple):
    """What a game shows after a step of four frames.

    Attributes:
        frame: grey, uint8 ``(84, 84)``.
        reward: change of the score, unclipped.
        over: the game is over.
        cut: the frame cap was reached.
        lives: lives left.
    """

    frame: np.ndarray
    reward: float
    over: bool
    cut: bool
    lives: int


class AtariGame:
    """An emulator in its own thread: :meth:`send` an action, :meth:`receive` what it shows.

    ale-py's vector environment repeats each action for four frames, takes the maximum of the last
    two, turns it grey and resizes it to 84 x 84. A game begins with 0 to 29 frames without action,
    drawn from the seed. Actions are not sticky, rewards are not clipped, and nothing happens at a
    lost life: :class:`~giril_rl.envs.AtariEnv` stacks frames and handles lives.

    Each game has its own interface so that it alone takes the steps that follow a lost life, in a
    batch of fixed order. One interface for all would be about 4% faster.

    Args:
        game: the ROM's name in ale-py, such as ``"breakout"``.
        frame_cap: emulated frames after which a game is cut.

    Raises:
        UserError: if ale-py is not installed or has no such game.

    Examples:
        >>> game = AtariGame("breakout")
        >>> frame, lives = game.reset(seed=0)
        >>> game.send(0)
        >>> frame.shape, lives, game.receive().reward
        ((84, 84), 5, 0.0)
    """

    def __init__(self, game: str, frame_cap: int = FRAME_CAP) -> None:
        interface, path = _rom(game)
        self._ale = interface(
            rom_path=path,
            num_envs=1,
            stack_num=1,
            frame_skip=SKIP,
            use_fire_reset=False,
            reward_clipping=False,
            max_episode_steps=frame_cap,
            num_threads=1,
        )
        self.meanings = [action.name for action in self._ale.get_action_set()]

    @property
    def fires(self) -> bool:
        """Whether a life begins with a press of the button, as in DeepMind's wrappers."""
        return self.meanings[1] == "FIRE" and len(self.meanings) >= 3

    def reset(self, seed: int | None = None) -> tuple[np.ndarray, int]:
        """Begins a game; its first frame ``(84, 84)`` and its lives.

        Args:
            seed: seeds the generator of the frames without action, whatever was played before.
                None draws its next number, in a tenth of the time: ale-py loads the game anew to
                seed it.
        """
        number = -1 if seed is None else seed & 0x7FFFFFFF  # ale-py takes 31 bits.
        shown, info = self._ale.reset([0], [number])
        return shown[0, 0], int(info["lives"][0])

    def send(self, action: int) -> None:
        """Starts ``action`` for four frames.

        Raises:
            ValueError: if the game has no such action; ale-py would wait forever.
        """
        if not 0 <= action < len(self.meanings):
            raise ValueError(f"the game has no action {action}, only 0 to {len(self.meanings) - 1}")
        self._ale.send([action], [1.0])

    def receive(self) -> Shown:
        """Waits for the result of the last :meth:`send`."""
        frame, reward, over, cut, info = self._ale.recv()
        return Shown(
            frame[0, 0], float(reward[0]), bool(over[0]), bool(cut[0]), int(info["lives"][0])
        )

    def play(self, action: int) -> Shown:
        """:meth:`send` and :meth:`receive`."""
        self.send(action)
        return self.receive()


def _rom(game: str) -> tuple[type, str]:
    try:
        from ale_py import ALEVectorInterface, roms
    except ImportError:
        raise UserError(
            'Atari needs ale-py, which is not installed: pip install "giril-rl[atari]".'
        ) from None
    names = roms.get_all_rom_ids()
    if game not in names:
        hint = did_you_mean(game, names) or "; names are written as in space_invaders."
        raise UserError(f"{game} is not a game of ale-py{hint}")
    return ALEVectorInterface, str(roms.get_rom_path(game))
