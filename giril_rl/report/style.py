"""Names, order and looks of methods, the same in every table and picture."""

from __future__ import annotations

from typing import NamedTuple

NAMES = {
    "expert": "expert",
    "true_reward": "PPO on the true reward",
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
_COLOURS = {
    "true_reward": SKY,
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
    """
    if method.startswith(CONTROL):
        name = f"control: {method.removeprefix(CONTROL).replace('_', ' ')}"
        return f"{name} (paper)" if profile == "paper" else name
    name = NAMES.get(method, method)
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


def look(method: str, profile: str | None, number: int = 0) -> Look:
    """Colour and line of a method; a method that is not known takes those of its number."""
    color = _COLOURS.get(method, PALETTE[number % len(PALETTE)])
    style = "--" if profile == "paper" else "-"
    if method not in _COLOURS:
        style = _STYLES[number // len(PALETTE) % len(_STYLES)]
    return Look(color, style)
