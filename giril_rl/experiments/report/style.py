"""Names, order and looks of methods, the same in every table and picture."""

from __future__ import annotations

from typing import NamedTuple

TRUE_REWARD = "expert:whole_budget"
"""A run of the recipe ``expert`` that takes its whole budget, as the methods beside it do."""
NAMES = {
    "expert": "expert",
    TRUE_REWARD: "PPO on the true reward",
    "giril": "GIRIL",
    "cdil": "CDIL",
    "gail": "GAIL",
    "vail": "VAIL",
    "bc": "BC",
}
CONTROL = "control:"
# Okabe and Ito's colours, which people who see colours differently can tell apart; their yellow is
# left out, for it is hard to see on white.
BLUE, ORANGE, GREEN, PINK, BLACK = "#0072B2", "#E69F00", "#009E73", "#CC79A7", "#000000"
SKY, RED, GREY = "#56B4E9", "#D55E00", "#8C8C8C"
PALETTE = (BLUE, RED, GREEN, PINK, ORANGE, SKY, BLACK, GREY)
EXPERT, DEMONSTRATION = BLACK, GREY
OWN = ("#6A3D9A", "#7CB518", "#8B4513", "#2F4F4F", "#8A8A00", "#8B0000")
"""For recipes of the user's own: none is a shipped method's, or is easily taken for one."""
_COLOURS = {
    TRUE_REWARD: SKY,
    "giril": BLUE,
    "cdil": RED,
    "gail": GREEN,
    "vail": PINK,
    "bc": ORANGE,
    "control:constant": BLACK,
    "control:untrained_giril": BLUE,
    "control:untrained_icm": RED,
    "control:copy": GREEN,
    "control:noise": PINK,
    "control:negated_giril": ORANGE,
    "control:centred_giril": SKY,
    "control:random": GREY,
    "control:held_action": RED,
}
_STYLES = ("-", "--", "-.", ":")


class Look(NamedTuple):
    """How a line is drawn."""

    color: str
    linestyle: str


def method_name(method: str, profile: str | None = None) -> str:
    """A method as tables name it.

    Examples:
        >>> method_name("giril", "paper"), method_name("control:untrained_icm")
        ('GIRIL (paper)', 'control: untrained icm')
        >>> method_name("my_recipe"), method_name("GAIL")
        ('my_recipe', 'GAIL (own)')
    """
    if method.startswith(CONTROL):
        name = f"control: {method.removeprefix(CONTROL).replace('_', ' ')}"
        return f"{name} (paper)" if profile == "paper" else name
    name = NAMES.get(method, method)
    if method not in NAMES and method in NAMES.values():  # A recipe in a file GAIL.py.
        name = f"{name} (own)"
    return f"{name} ({profile})" if profile else name


def rank(method: str) -> tuple[int, str]:
    """Where a method stands in a table: as in the paper, what is unknown next, then controls.

    Examples:
        >>> sorted(["control:copy", "bc", "mine", "giril"], key=rank)
        ['giril', 'bc', 'mine', 'control:copy']
    """
    known = list(NAMES)
    if method in known:
        return known.index(method), ""
    return len(known) + method.startswith(CONTROL), method


def is_own(method: str) -> bool:
    """Whether a method is a recipe of the user's own.

    Examples:
        >>> is_own("my_recipe"), is_own("giril"), is_own("control:copy")
        (True, False, False)
    """
    return method not in NAMES and not method.startswith(CONTROL)


def look(method: str, profile: str | None, number: int = 0) -> Look:
    """Colour and line of a method; of what is not shipped by its number, the same in all pictures.

    Examples:
        >>> look("giril", "paper")
        Look(color='#0072B2', linestyle='--')
        >>> look("my_recipe", None, 1)
        Look(color='#7CB518', linestyle='-')
    """
    if method in _COLOURS:
        return Look(_COLOURS[method], _STYLES[profile == "paper"])
    turn = 2 * (number // len(OWN)) + (profile == "paper")
    return Look(OWN[number % len(OWN)], _STYLES[turn % len(_STYLES)])
