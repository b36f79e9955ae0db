"""A lean batched TorchRL environment over Gymnasium environments with vector observations."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Unbounded

from giril_rl.envs.batched import BatchedEnv
from giril_rl.envs.checking import check_reset, check_step, env_name
from giril_rl.envs.saved import check_actions, check_counts, saved_array, saved_seed, saved_tensor
from giril_rl.envs.spaces import (
    action_spec,
    fill_unbounded,
    shortest_limit,
    without_bookkeeping,
)
from giril_rl.envs.stdout import silent_stdout
from giril_rl.errors import UserError
from giril_rl.runs.randomness import Use


class GymVectorEnv(BatchedEnv):
    """``num_envs`` copies of a Gymnasium environment stepped as one TorchRL environment.

    ``("next", "observation")`` at an episode's end is the true terminal observation; the reset
    observation appears only as the next step's ``"observation"``. A time limit is a truncation,
    a failure a termination. Every episode has a seed of its own, drawn from ``seed``, the copy's
    index and the episode's number, so that any moment of a run can be rebuilt by replaying the
    actions since the last reset (:meth:`simulator_state`, :meth:`restore_simulator`).

    A copy is stepped with the action clamped to its bounds, in each dimension that has one: most
    simulators clamp by themselves before they act, but some pay for the action as it was given.
    Observations become float32, whatever numbers they are.

    TorchRL's own ``GymWrapper(SyncVectorEnv(...))`` gives the same transitions; this class exists
    because it is 1.4 times as fast for simulators that step in tens of microseconds
    (``tests/benchmarks/parts.py``), and because Gymnasium has no way to save a simulator's state.

    Args:
        make_fn: makes one Gymnasium environment, a new one at each call, with a one-dimensional
            Box observation and a Box (of real numbers) or Discrete (counted from 0) action space.
            Discrete actions are integers, not one-hot vectors.
        num_envs: number of copies, the environment's batch size.
        seed: root of the episodes' seeds.
        use: what the episodes are for; those of two uses never have equal seeds.
        max_episode_steps: a time limit in steps beside those that the environment has; the
            shortest counts. ``gymnasium.make(id, max_episode_steps=...)`` replaces the one that it
            is registered with.

    Raises:
        UserError: if the observation or action space is of another kind, if ``make_fn`` returns one
            environment several times or environments that differ; at the first reset or step, if an
            observation is not of its space's shape or a reward is not a number.

    Examples:
        >>> import gymnasium
        >>> env = GymVectorEnv(lambda: gymnasium.make("CartPole-v1"), num_envs=4, seed=0)
        >>> env.rollout(10, break_when_any_done=False)["next", "observation"].shape
        torch.Size([4, 10, 4])
    """

    _failure_ends = True
    """Whether a simulator is reset when it fails."""

    def __init__(
        self,
        make_fn: Callable[[], gymnasium.Env],
        num_envs: int,
        *,
        seed: int = 0,
        use: Use = "training",
        max_episode_steps: int | None = None,
    ) -> None:
        super().__init__(num_envs, seed=seed, use=use)
        if max_episode_steps is not None and max_episode_steps < 1:
            raise UserError(f"max_episode_steps={max_episode_steps}: at least 1 is needed.")
        with silent_stdout():
            made = [make_fn() for _ in range(num_envs)]
        _check_copies(made)
        self._gym_envs, limits = zip(*map(without_bookkeeping, made), strict=True)
        limits = [limit for limit in (max_episode_steps, limits[0]) if limit is not None]
        self._limit: int | None = min(limits, default=None)
        self._steps = np.zeros(num_envs, dtype=np.int64)
        self._started = self._stepped = False
        self._actions: list[np.ndarray] = []
        self._last_observation = np.zeros((num_envs, 0), dtype=np.float32)
        self._make_specs(self._gym_envs[0])

    def _make_specs(self, env: gymnasium.Env) -> None:
        observation, action = env.observation_space, env.action_space
        name = env_name(env)
        if not isinstance(observation, gymnasium.spaces.Box) or len(observation.shape) != 1:
            raise UserError(
                f"{name} has observations of the kind {observation}: choose a task with a vector "
                "(one-dimensional Box) observation."
            )
        n = self.batch_size[0]
        actions = action_spec(action, n, name)
        bounded = isinstance(actions, Bounded)
        self._bounds = (action.low, action.high) if bounded else None  # type: ignore[attr-defined]
        self._half_bounded = (
            bounded and not (actions.space.high - actions.space.low).isfinite().all()
        )
        self._declare(Unbounded((n, *observation.shape), dtype=torch.float32), actions)
        self._last_observation = np.zeros((n, *observation.shape), dtype=np.float32)

    def rand_action(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        """TorchRL's, and :func:`fill_unbounded` where a dimension lacks a bound."""
        drawn = super().rand_action(tensordict)
        if self._half_bounded:
            fill_unbounded(drawn.get("action"), self.action_spec)
        return drawn

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        # A copy, for the caller may reuse its memory and the history may not change.
        actions = tensordict.get("action").numpy()
        actions = actions.copy() if self._bounds is None else actions.clip(*self._bounds)
        self._actions.append(actions)
        n = len(self._gym_envs)
        observation = np.empty_like(self._last_observation)
        reward = np.empty((n, 1), dtype=np.float32)
        ends: list[bool] = []
        cuts: list[bool] = []
        unseen = not self._stepped
        for i, env in enumerate(self._gym_envs):
            returned = env.step(actions[i])
            if unseen:
                check_step(env, returned)
            observation[i], reward[i, 0], terminated, truncated, _ = returned
            ends.append(terminated)
            cuts.append(truncated)
        self._stepped = True
        self._steps += 1
        failed = np.array(ends, dtype=bool)
        cut = np.array(cuts, dtype=bool)
        if self._limit is not None:
            cut |= self._steps >= self._limit
        self._last_observation = observation
        return TensorDict(
            {
                "observation": torch.from_numpy(observation),
                "reward": torch.from_numpy(reward),
                "done": torch.from_numpy(failed | cut).unsqueeze(-1),
                "terminated": torch.from_numpy(failed).unsqueeze(-1),
                "truncated": torch.from_numpy(cut).unsqueeze(-1),
            },
            batch_size=self.batch_size,
        )

    def _reset_where(self, mask: np.ndarray) -> np.ndarray:
        self._steps[mask] = 0
        return self._restart(mask)

    def _restart(self, mask: np.ndarray) -> np.ndarray:
        """Resets simulators, each with its next episode's seed; what all copies then show."""
        observation = self._last_observation.copy()
        with silent_stdout() if not self._started else contextlib.nullcontext():
            for i in np.flatnonzero(mask).tolist():
                env = self._gym_envs[i]
                observation[i], _ = check_reset(env, env.reset(seed=self._episode_seed(i)))
                self._episode[i] += 1
        self._started = True
        self._last_observation = observation
        del self._actions[: len(self._actions) - int(self._replayed().max())]
        return observation

    def _replayed(self) -> np.ndarray:
        """How many actions lead each copy from its simulator's last reset to where it stands."""
        return self._steps

    def simulator_state(self) -> dict[str, Any]:
        """What :meth:`restore_simulator` needs to bring another instance to this very moment.

        Returns:
            Tensors only: the episodes' numbers and lengths, the actions since the longest running
            episode began, shape ``(time, num_envs, ...)``, and the present observation.
        """
        actions = np.stack(self._actions) if self._actions else np.zeros((0,), dtype=np.float32)
        return {
            "seed": self._root_seed,
            "episode": torch.from_numpy(self._episode.copy()),
            "steps": torch.from_numpy(self._steps.copy()),
            "actions": torch.from_numpy(actions),
            "observation": torch.from_numpy(self._last_observation.copy()),
        }

    def restore_simulator(self, state: dict[str, Any]) -> bool:
        """Replays the running episodes; the next :meth:`reset` hands out where they stand.

        Args:
            state: what :meth:`simulator_state` returned for an equal environment.

        Returns:
            Whether the replay came to the same moment. If not, the simulator does not repeat itself
            for the same seed and actions, and all copies begin their next episodes.

        Raises:
            ValueError: if it is no state of such an environment; nothing is played then.
        """
        saved = saved_array(state, "observation", self._last_observation)
        self._root_seed = saved_seed(state)
        self._episode = saved_array(state, "episode", self._episode)
        self._steps = saved_array(state, "steps", self._steps)
        self._restore_clocks(state)
        steps = self._replayed()
        actions = saved_tensor(state, "actions")
        check_counts("episode", self._episode, 1)
        check_counts("steps", steps, 0, len(actions))
        if steps.max():
            count = getattr(self.action_spec.space, "n", None)
            check_actions(actions, self.action_spec.shape, self._bounds, count)
        self._actions = list(actions) if steps.max() else []
        with silent_stdout():
            shown = [self._replay(i, actions[len(actions) - steps[i] :]) for i in range(len(saved))]
        self._started = self._restored = True
        self._last_observation = saved
        if all(
            one is not None and np.array_equal(one, other)
            for one, other in zip(shown, saved, strict=True)
        ):
            return True
        self._reset_where(np.ones(len(saved), dtype=bool))
        return False

    def _replay(self, i: int, actions: np.ndarray) -> np.ndarray | None:
        """What copy ``i`` shows after its ``actions``; None if its episode ended before them."""
        env = self._gym_envs[i]
        self._episode[i] -= 1
        observation, _ = env.reset(seed=self._episode_seed(i))
        self._episode[i] += 1
        over = False
        for action in actions:
            if over:
                return None
            observation, _, failed, cut, _ = env.step(action[i])
            over = cut or (failed and self._failure_ends)
        return np.asarray(observation, dtype=np.float32)

    def _restore_clocks(self, state: dict[str, Any]) -> None:
        """Takes what a subclass added to :meth:`simulator_state`."""

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Closes every copy."""
        if not self.is_closed:
            for env in self._gym_envs:
                env.close()
        super().close(raise_if_closed=raise_if_closed)


def _check_copies(envs: list[gymnasium.Env]) -> None:
    """Refuses environments that share a simulator, or are not of one kind."""
    name = env_name(envs[0])
    if len({id(env.unwrapped) for env in envs}) < len(envs):
        raise UserError(
            f"make_fn returned the same {name} several times, which cannot play {len(envs)} "
            "episodes at once: make a new environment at each call."
        )
    kinds = {
        "observation_space": lambda env: (env.observation_space.shape, env.observation_space.dtype),
        "action_space": lambda env: env.action_space,
        "time limit": shortest_limit,
    }
    for what, kind in kinds.items():
        if any(kind(env) != kind(envs[0]) for env in envs):
            raise UserError(
                f"make_fn returned environments that differ in their {what}: make equal ones."
            )
