"""Records a policy's episodes, then checks and replays them."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from itertools import count
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor

from giril_rl.demos.arrays import to_transitions
from giril_rl.demos.demonstration import Demonstration
from giril_rl.demos.replay import as_executed, as_recorded, verify_by_replay
from giril_rl.envs.gym_api import (
    check_action_space,
    check_reset,
    check_step,
    env_name,
    silent_stdout,
)
from giril_rl.errors import UserError
from giril_rl.runs.machine import installed_versions, processor
from giril_rl.runs.progress import progress
from giril_rl.runs.randomness import seeded, stream_seed

TRIES = 30
"""Episodes in a row that may repeat earlier ones: an Atari game has as many beginnings."""
_LONGEST_EPISODE = 1_000_000


def episode_seed(seed: int, episode: int) -> int:
    """The reset seed of one episode of a recording."""
    return stream_seed("demonstration", seed, episode, bits=32)


def record_demonstration(
    make_fn: Callable[[], gymnasium.Env],
    policy: Callable[[Tensor], Tensor],
    *,
    seed: int,
    length: int | None = None,
    episodes: int | None = None,
    deterministic: bool = True,
    task: str | None = None,
    expert: dict[str, Any] | None = None,
    lives: str | None = None,
    show_progress: bool = True,
) -> Demonstration:
    """Records a policy's transitions, then proves them by check and by replay.

    Every episode has its own seed. Of whole episodes, those that repeat an earlier one are dropped:
    a deterministic policy in a game with few beginnings often repeats itself. Actions are stored as
    executed, clipped to the bounds of a Box. Torch's generator is seeded for the recording and then
    restored, so that a sampled policy repeats as well.

    Args:
        make_fn: makes the Gymnasium environment: flat observation or uint8 images [c, h, w], Box
            or Discrete actions, as :class:`~giril_rl.envs.GymVectorEnv` takes them.
        policy: observation float32 [1, d], or uint8 [1, c, h, w], -> action float [1, a] (Box) or
            int64 [1] (Discrete), played as returned: the policy chooses between mean and sample.
        seed: root of the episodes' seeds.
        length: number of transitions; it cuts the last episode.
        episodes: number of whole, distinct episodes, instead of ``length``.
        deterministic: how ``policy`` chooses, for the card.
        task: the task's name, for the card.
        expert: score and source of the policy, for the card; plain JSON values.
        lives: which lives of a game an episode has, for the card: "first" or "all".
        show_progress: show a progress bar.

    Returns:
        The demonstration. Its card has ``task``, ``env_id``, ``seed``, ``seeds``, ``length``,
        ``deterministic``, ``expert``, ``versions``, ``processor``, ``transitions`` and
        ``episode_returns``; a game's also ``lives``, ``lives_left`` (at each episode's beginning
        and end) and ``actions``, their names.

    Raises:
        UserError: unless exactly one of ``length`` and ``episodes`` is positive; for an action that
            is not finite or not in the space; for an environment that does not repeat itself, or
            whose spaces, observations or rewards are wrong.

    Examples:
        >>> demo = record_demonstration(
        ...     lambda: gymnasium.make("CartPole-v1"), lambda o: torch.ones(1, dtype=torch.int64),
        ...     length=20, seed=0,
        ... )
        >>> len(demo), demo.transitions["next", "done"].sum().item(), demo.num_episodes
        (20, 2, 3)
    """
    if (length is None) == (episodes is None) or (length or episodes or 0) < 1:
        raise UserError(
            f"demo.length={length} and demo.episodes={episodes}: give exactly one of them, at "
            "least 1, and null for the other."
        )
    env = make_fn()
    check_action_space(env.action_space, env_name(env))
    parts: list[dict[str, np.ndarray]] = []
    seeds: list[int] = []
    lives_left: list[list[int]] = []
    distinct, numbers = _Distinct(episodes or 0), count()
    total, unit = (length, "steps") if length is not None else (episodes, "episodes")
    try:
        with (
            seeded(episode_seed(seed, 0)),
            torch.no_grad(),
            progress(total or 0, desc="demonstration", unit=unit, disable=not show_progress) as bar,
        ):
            while bar.n < (total or 0):
                own = episode_seed(seed, next(numbers))
                most = _LONGEST_EPISODE if length is None else length - bar.n
                played, counted = _play(env, policy, own, most)
                if length is None and not (played[-1]["terminated"] or played[-1]["truncated"]):
                    raise UserError(
                        f"an episode did not end within {most:,} steps: give the task a "
                        "max_episode_steps, or set demo.length."
                    )
                if length is None and not distinct.is_new(played):
                    continue
                seeds.append(own)
                lives_left.append(counted)
                parts.append(_columns(played, len(parts)))
                bar.update(1 if length is None else len(played))
    finally:
        env.close()
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    demo = Demonstration(to_transitions(columns))
    demo.card = {
        "task": task,
        "env_id": env.spec.id if env.spec is not None else None,
        "seed": seed,
        "seeds": seeds,
        "length": length,
        "deterministic": deterministic,
        "expert": expert,
        "versions": installed_versions(),
        "processor": processor(),
        "transitions": len(demo),
        "episode_returns": demo.returns.tolist(),
    }
    if lives is not None:
        demo.card["lives"] = lives
    if all(lives_left):
        demo.card["lives_left"] = lives_left
    meanings = getattr(env.unwrapped, "get_action_meanings", None)  # As ale-py calls it.
    if meanings is not None:
        demo.card["actions"] = list(meanings())
    demo.check()
    verify_by_replay(demo, make_fn)
    return demo


def _play(
    env: gymnasium.Env, policy: Callable[[Tensor], Tensor], seed: int, most: int
) -> tuple[list[dict[str, Any]], list[int]]:
    """One episode from ``seed``, or its first ``most`` transitions, and lives before and after."""
    rows: list[dict[str, Any]] = []
    with silent_stdout():  # Simulators connect here, and may print.
        observation, info = check_reset(env, env.reset(seed=seed))
    lives = [info.get("lives")]
    before = as_recorded(observation)
    while len(rows) < most:
        action = _choose(policy, before, env.action_space)
        observation, reward, terminated, truncated, info = check_step(
            env, env.step(as_executed(action, env.action_space))
        )
        after = as_recorded(observation)
        rows.append(
            {
                "observation": before,
                "action": action,
                "next_observation": after,
                "reward": float(reward),
                "terminated": bool(terminated),
                "truncated": bool(truncated),
            }
        )
        before = after
        if terminated or truncated:
            break
    lives.append(info.get("lives"))
    return rows, [int(count) for count in lives if count is not None]


def _choose(
    policy: Callable[[Tensor], Tensor], observation: np.ndarray, space: gymnasium.Space
) -> np.ndarray | int:
    """The policy's action as it will be executed and stored: float32 [a], or an int."""
    output = policy(torch.from_numpy(observation).unsqueeze(0)).detach().cpu()[0].numpy()
    if isinstance(space, gymnasium.spaces.Box):
        if not np.isfinite(output).all():
            raise UserError(f"the policy's action {output.tolist()} is not finite: check it.")
        low, high = space.low.reshape(-1), space.high.reshape(-1)
        return np.clip(output.reshape(-1).astype(np.float32), low, high).astype(np.float32)
    if output.ndim != 0 or not np.issubdtype(output.dtype, np.integer):
        raise UserError(
            f"the policy's action {output.tolist()} is not one integer: a Discrete action space "
            "takes int64 [1]."
        )
    if not space.contains(int(output)):
        raise UserError(f"the policy's action {int(output)} is not in {space}: check the policy.")
    return int(output)


def _columns(rows: list[dict[str, Any]], episode: int) -> dict[str, np.ndarray]:
    """The columns of one episode, see :func:`~giril_rl.demos.arrays.to_transitions`."""
    columns = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
    return {**columns, "episode": np.full(len(rows), episode), "step": np.arange(len(rows))}


class _Distinct:
    """Tells which episodes repeat an earlier one, and gives up after :data:`TRIES` in a row."""

    def __init__(self, wanted: int) -> None:
        self._wanted = wanted
        self._known: set[bytes] = set()
        self._repeats = 0

    def is_new(self, played: list[dict[str, Any]]) -> bool:
        content = hashlib.blake2b(played[0]["observation"].tobytes())
        for row in played:
            content.update(np.asarray(row["action"]).tobytes())
            content.update(row["next_observation"].tobytes())
        if content.digest() not in self._known:
            self._known.add(content.digest())
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
