"""Where rewards read a transition and are written, unless told otherwise."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict.utils import NestedKey

from giril_rl.errors import UserError

TRANSITION_KEYS: tuple[NestedKey, ...] = ("observation", "action", ("next", "observation"))
PAIR_KEYS: tuple[NestedKey, ...] = ("observation", "action")
REWARD_KEYS: tuple[NestedKey, ...] = (("next", "intrinsic_reward"),)


def check_keys(
    what: str, roles: Sequence[str], in_keys: Sequence[NestedKey], out_keys: Sequence[NestedKey]
) -> None:
    """Refuses another number of ``in_keys`` than there are roles, or of ``out_keys`` than one.

    Args:
        what: the reward's name, for the message.
        roles: what the two or three ``in_keys`` stand for, in order.
        in_keys: the keys that it is to read.
        out_keys: the keys that it is to write.

    Raises:
        UserError: for a wrong number.

    Examples:
        >>> check_keys("a reward", ["observation", "action"], ["o", "a"], ["r"])
        >>> check_keys("a reward", ["observation", "action"], ["o"], ["r"])
        Traceback (most recent call last):
        giril_rl.errors.UserError: a reward has two in_keys (observation, action) and one out_key,
        not ['o'] and ['r'].
    """
    if len(in_keys) != len(roles) or len(out_keys) != 1:
        number = {2: "two", 3: "three"}[len(roles)]
        raise UserError(
            f"{what} has {number} in_keys ({', '.join(roles)}) and one out_key, not "
            f"{list(in_keys)} and {list(out_keys)}."
        )
