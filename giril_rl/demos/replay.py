"""Replays a demonstration, to prove that its actions belong to their states."""

from __future__ import annotations

from collections.abc import Callable

import gymnasium
import numpy as np

from giril_rl.demos.demonstration import Demonstration
from giril_rl.envs.gym_api import silent_stdout
from giril_rl.errors import UserError


def as_executed(action: np.ndarray | int, space: gymnasium.Space) -> np.ndarray | int:
    """A recorded action in the form that ``space``'s environment steps with."""
    if isinstance(space, gymnasium.spaces.Box):
        return np.asarray(action, dtype=space.dtype).reshape(space.shape)
    return int(action)


def as_recorded(observation: object) -> np.ndarray:
    """A copy of an observation, since some environments reuse one array for all steps.

    Images, uint8 of three dimensions, keep their type and shape; all else becomes float32 [d].
    """
    array = np.asarray(observation)
    if array.dtype == np.uint8 and array.ndim == 3:
        return array.copy()
    return np.array(observation, dtype=np.float32).reshape(-1)


def verify_by_replay(
    demo: Demonstration, make_fn: Callable[[], gymnasium.Env], *, tolerance: float = 0.0
) -> None:
    """Plays each episode's actions from its seed in a fresh environment and compares everything.

    This catches actions stored one step early or late, which the data alone cannot show.

    Args:
        demo: a demonstration with ``card["seeds"]``.
        make_fn: makes the Gymnasium environment that it was recorded in.
        tolerance: largest difference that passes, of images in grey levels; 0 asks for the same
            bits, which a deterministic simulator gives on the same machine.

    Raises:
        UserError: at the first transition that differs, or whose action does not exist; without
            seeds or actions.

    Examples:
        >>> from giril_rl.demos import record_demonstration
        >>> make_fn = lambda: gymnasium.make("CartPole-v1")
        >>> balance = lambda observation: (observation[:, 2] + observation[:, 3] > 0).long()
        >>> demo = record_demonstration(make_fn, balance, length=50, seed=0)
        >>> verify_by_replay(demo, make_fn)
        >>> late = demo.transitions.clone()
        >>> late["action"] = late["action"].roll(1, 0)
        >>> verify_by_replay(Demonstration(late, demo.card), make_fn)  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: replaying the demonstration's actions leads elsewhere ...
    """
    if not demo.has_actions:
        raise UserError("the demonstration has no actions, so there is nothing to replay.")
    seeds = demo.card.get("seeds", [])
    if len(seeds) != demo.num_episodes:
        raise UserError(
            f"the demonstration's card has {len(seeds)} seeds for {demo.num_episodes} episodes, so "
            "it cannot be replayed: record it with giril_rl."
        )
    data = {
        key: demo.transitions.get(key).numpy()
        for key in ("observation", "action", "episode", "step")
    }
    names = ("observation", "reward", "terminated", "truncated")
    after = {name: demo.transitions["next", name].numpy() for name in names}
    index = 0
    for seed, length in zip(seeds, demo.lengths.tolist(), strict=True):
        env = make_fn()
        try:
            with silent_stdout():  # Simulators connect here, and may print.
                observation, _ = env.reset(seed=int(seed))
            _compare(
                "reset", index, data["observation"][index], as_recorded(observation), tolerance
            )
            for _ in range(length):
                action = as_executed(data["action"][index], env.action_space)
                _check_action(action, env.action_space, index)
                outcome = env.step(action)[:4]
                for name, value in zip(names, outcome, strict=True):
                    _compare(name, index, after[name][index], as_recorded(value), tolerance)
                index += 1
        finally:
            env.close()


def _check_action(action: np.ndarray | int, space: gymnasium.Space, index: int) -> None:
    """Refuses an integer that is not an action; real ones outside their bounds are clamped."""
    if isinstance(space, gymnasium.spaces.Discrete) and not space.contains(action):
        raise UserError(
            f"the demonstration has the action {action} at index {index}, and the environment has "
            f"none but {int(space.start)} to {int(space.start + space.n) - 1}: it is of another "
            "environment."
        )


def _compare(
    name: str, index: int, recorded: np.ndarray, played: np.ndarray, tolerance: float
) -> None:
    recorded = as_recorded(recorded)
    if recorded.shape != played.shape:
        raise UserError(
            f"replaying the demonstration gives {name} of shape {list(played.shape)} where "
            f"{list(recorded.shape)} was recorded: it is of another environment."
        )
    if recorded.dtype == np.uint8:  # Differences of bytes wrap around.
        recorded, played = recorded.astype(np.int16), played.astype(np.int16)
    difference = float(np.abs(recorded - played).max(initial=0.0))
    if difference <= tolerance:
        return
    if name == "reset":
        raise UserError(
            f"resetting the environment with the demonstration's seed gives another first "
            f"observation at index {index} (off by {difference:.3g}): it was recorded in another "
            "environment, or the environment's reset does not follow its seed."
        )
    raise UserError(
        f"replaying the demonstration's actions leads elsewhere at index {index} (next {name} off "
        f"by {difference:.3g}): the actions are not aligned with the states, or the environment is "
        "another one or not deterministic; record it anew."
    )
