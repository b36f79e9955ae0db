"""How much of a demonstration is used, and its training and validation parts."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from giril_rl.demos.demonstration import Demonstration
from giril_rl.errors import UserError


def shortened(
    demo: Demonstration, *, episodes: int | None = None, first: int | None = None
) -> Demonstration:
    """The first whole episodes of a demonstration, or its first transitions.

    The card's ``taken_from`` then says how many ``transitions`` there were, and the mean return of
    the whole episodes that they are taken from, None where rewards are not known.

    Args:
        demo: the demonstration; not changed.
        episodes: how many whole episodes; None takes all there is.
        first: how many transitions, of those episodes; None takes all. It may cut an episode.

    Raises:
        UserError: if there are fewer.

    Examples:
        >>> import gymnasium
        >>> from giril_rl.demos import record_demonstration
        >>> demo = record_demonstration(
        ...     lambda: gymnasium.make("CartPole-v1"), lambda o: o.new_ones(1).long(),
        ...     episodes=3, seed=0,
        ... )
        >>> part = shortened(demo, episodes=2, first=12)
        >>> demo.lengths.tolist(), part.lengths.tolist()
        ([10, 8, 9], [10, 2])
        >>> part.card["taken_from"]
        {'transitions': 27, 'return_mean': 9.0}
    """
    if episodes is None and first is None:
        return demo
    part, card = demo.transitions, dict(demo.card)
    whole = demo.num_episodes - (not demo.transitions["next", "done"][-1])
    if episodes is not None:
        if episodes > whole:
            raise UserError(
                f"demo.episodes={episodes}: the demonstration has {whole} whole episodes: give at "
                "most that, or null for all of it."
            )
        part, card["length"] = part[part["episode"] < episodes], None
    if first is not None:
        if first > len(part):
            raise UserError(
                f"demo.first={first}: the demonstration has {len(part):,} transitions"
                f"{f' in {episodes} episodes' if episodes is not None else ''}: give at most that, "
                "or null for all of them."
            )
        part, card["length"] = part[:first], first
    taken = Demonstration(part.clone(), card)
    card |= {
        "transitions": len(taken),
        "taken_from": {
            "transitions": len(demo),
            "return_mean": demo.mean_return(episodes) if demo.has_rewards else None,
        },
    }
    for name in ("seeds", "episode_returns", "lives_left"):
        if isinstance(card.get(name), list):
            card[name] = card[name][: taken.num_episodes]
    return taken


def subsample(demo: Demonstration, every: int, offset: int = 0) -> TensorDict:
    """Each ``every``-th transition, counted across episodes: ``ceil((N - offset) / every)`` of N.

    The paper's continuous control tasks keep one transition in 20 of 1,000 steps: 50 pairs.

    Args:
        demo: the demonstration; not changed.
        every: keep 1 in this many; 1 keeps all.
        offset: index of the first one kept, below ``every``.

    Raises:
        UserError: if these are out of range, or nothing would be left.

    Examples:
        >>> data = TensorDict({"step": torch.arange(10)}, [10])
        >>> subsample(Demonstration(data), every=4)["step"].tolist()
        [0, 4, 8]
        >>> holdout(Demonstration(data), every=4)["step"].tolist()
        [1, 2, 3, 5, 6, 7, 9]
    """
    return demo.transitions[_kept(demo, every, offset)]


def holdout(demo: Demonstration, every: int, offset: int = 0) -> TensorDict:
    """The transitions that :func:`subsample` leaves out, none for ``every=1``; for validation."""
    return demo.transitions[~_kept(demo, every, offset)]


def _kept(demo: Demonstration, every: int, offset: int) -> torch.Tensor:
    if every < 1 or not 0 <= offset < every:
        raise UserError(
            f"subsample={every} with offset {offset} keeps nothing sensible: "
            "give a whole number from 1, and an offset below it."
        )
    if offset >= len(demo):
        raise UserError(
            f"subsample={every} with offset {offset} keeps none of {len(demo)} transitions: "
            "give smaller ones."
        )
    return torch.arange(len(demo)) % every == offset
