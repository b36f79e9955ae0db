"""Are two episodes the same one?"""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np

from giril_rl.errors import UserError

TRIES = 30
"""Episodes in a row that may repeat earlier ones: as many as an Atari game has beginnings."""


class DistinctEpisodes:
    """Tells which episodes of a recording repeat an earlier one, and when to give up.

    Args:
        wanted: number of episodes that are asked for, for the refusal.

    Examples:
        >>> row = {"observation": np.zeros(2), "action": 1, "next": np.ones(2)}
        >>> distinct = DistinctEpisodes(wanted=2)
        >>> distinct.add([row]), distinct.add([row]), distinct.add([row, row])
        (True, False, True)
    """

    def __init__(self, wanted: int) -> None:
        self._wanted = wanted
        self._known: set[bytes] = set()
        self._repeats = 0

    def add(self, played: list[dict[str, Any]]) -> bool:
        """Whether an episode is another than all before it.

        Args:
            played: a row for each transition, with ``observation``, ``action`` and ``next``.

        Raises:
            UserError: at the 30th episode in a row that is not.
        """
        digest = _digest(played)
        if digest not in self._known:
            self._known.add(digest)
            self._repeats = 0
            return True
        self._repeats += 1
        if self._repeats == TRIES:
            found = len(self._known)
            raise UserError(
                f"demo.episodes={self._wanted}: only {found} different ones were found, the last "
                f"{TRIES} repeat them; set demo.episodes={found}, or demo.deterministic=false, "
                "which samples the player's actions."
            )
        return False


def _digest(played: list[dict[str, Any]]) -> bytes:
    content = hashlib.blake2b(played[0]["observation"].tobytes())
    for row in played:
        content.update(np.asarray(row["action"]).tobytes())
        content.update(row["next"].tobytes())
    return content.digest()
