"""Registry entries of methods, and those of the player and of your own recipes."""

from __future__ import annotations

from functools import cache

from giril_rl.methods.registry import CONTROL, methods
from giril_rl.rewards.method import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PINK,
    RED,
    SKY,
    Method,
    registered,
)

PLAYER = "expert"
TRUE_REWARD = "expert:whole_budget"
"""A run of the recipe ``expert`` that takes its whole budget, like the methods beside it."""
_PLAYERS = {
    PLAYER: Method(PLAYER, "expert", BLACK),
    TRUE_REWARD: Method(TRUE_REWARD, "PPO on the true reward", SKY),
}
PALETTE = (BLUE, RED, GREEN, PINK, ORANGE, SKY, BLACK, GREY)
OWN = ("#6A3D9A", "#7CB518", "#8B4513", "#2F4F4F", "#8A8A00", "#8B0000")
"""Colours of your own recipes, which are easily told from those of the registered methods."""


@cache
def _import_methods() -> None:
    methods()


def _known() -> dict[str, Method]:
    _import_methods()
    return _PLAYERS | registered()


def is_own(method: str) -> bool:
    """Whether a method is neither registered nor the player, such as a recipe of your own.

    Examples:
        >>> is_own("my_recipe"), is_own("giril")
        (True, False)
    """
    return method not in _known()


def entry(method: str, number: int = 0) -> Method:
    """The entry of a registered method or of the player; a new one for any other name.

    Args:
        method: the method as ``result.json`` names it.
        number: tells your own recipes apart.

    Examples:
        >>> entry("giril").label, entry("control:untrained_icm").label
        ('GIRIL', 'control: untrained icm')
        >>> entry("my_recipe", 1).colour, entry("GAIL").label
        ('#7CB518', 'GAIL (own)')
    """
    known = _known()
    if method in known:
        return known[method]
    colour = OWN[number % len(OWN)]
    if method.startswith(CONTROL):
        label = method.replace(":", ": ").replace("_", " ")
        return Method(method, label, colour, kind="control")
    taken = method in {other.label for other in known.values()}  # A recipe in a file GAIL.py.
    return Method(method, f"{method} (own)" if taken else method, colour)


def order(method: str) -> tuple[int, int, str]:
    """Sorts players first, then registered methods, your own recipes and controls.

    Examples:
        >>> sorted(["control:copy", "bc", "mine", "giril", "expert"], key=order)
        ['expert', 'giril', 'bc', 'mine', 'control:copy']
    """
    known = list(_known())
    group = 2 if entry(method).kind == "control" else int(is_own(method))
    return group, known.index(method) if method in known else len(known), method
