"""A lean batched TorchRL environment over copies of a Gymnasium environment."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, TensorSpec, Unbounded

from giril_rl.envs.batched import (
    BatchedEnv,
    check_counts,
    saved_array,
    saved_seed,
    saved_tensor,
)
from giril_rl.envs.gym_api import (
    action_spec,
    check_copies,
    check_reset,
    check_step,
    env_name,
    fill_unbounded,
    shortest_limit,
    silent_stdout,
    without_bookkeeping,
)
from giril_rl.errors import UserError
from giril_rl.runs.randomness import Use


class GymVectorEnv(BatchedEnv):
    """``num_envs`` copies of a Gymnasium environment stepped as one TorchRL environment.

    ``("next", "observation")`` at an episode's end is the true terminal observation. A time limit
    truncates, a failure terminates. See :class:`BatchedEnv` for seeds and restoring.

    Actions are clamped to their bounds, in each dimension that has one: most simulators clamp by
    themselves, but some pay for the action as given. Observations become float32.

    TorchRL's ``GymWrapper(SyncVectorEnv(...))`` gives the same transitions. This class is 1.4 times
    as fast for simulators that step in tens of microseconds (``tests/benchmarks/parts.py``) and can
    save a simulator's state, which Gymnasium cannot.

    Args:
        make_fn: makes a new Gymnasium environment at each call, with a one-dimensional Box
            observation and a Box (of real numbers) or Discrete (counted from 0) action space.
            Discrete actions are integers, not one-hot vectors.
        num_envs: number of copies, the environment's batch size.
        seed: root of the episodes' seeds.
        use: what the episodes are for; two uses never share seeds.
        max_episode_steps: a further time limit in steps; the shortest of all counts.
            ``gymnasium.make(id, max_episode_steps=...)`` replaces the registered one.

    Raises:
        UserError: for another kind of space; if ``make_fn`` returns one environment several times,
            or environments that differ; at the first reset or step, if an observation is not of its
            space's shape or a reward is not a number.

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
        check_copies(made)
        self._gym_envs, limits = zip(*map(without_bookkeeping, made), strict=True)
        limits = [limit for limit in (max_episode_steps, limits[0]) if limit is not None]
        self._limit: int | None = min(limits, default=None)
        self._steps = np.zeros(num_envs, dtype=np.int64)
        self._started = self._stepped = False
        self._actions: list[np.ndarray] = []
        self._make_specs(self._gym_envs[0])

    def _make_specs(self, env: gymnasium.Env) -> None:
        observation = self._observation_spec(env)
        action = env.action_space
        actions = action_spec(action, self.batch_size[0], env_name(env))
        bounded = isinstance(actions, Bounded)
        self._bounds = (action.low, action.high) if bounded else None  # type: ignore[attr-defined]
        self._half_bounded = (
            bounded and not (actions.space.high - actions.space.low).isfinite().all()
        )
        self._declare(observation, actions)
        self._last_observation = observation.zero().numpy()

    def _observation_spec(self, env: gymnasium.Env) -> TensorSpec:
        space = env.observation_space
        if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
            raise UserError(
                f"{env_name(env)} has observations of the kind {space}: choose a task with a "
                "vector (one-dimensional Box) observation."
            )
        return Unbounded((self.batch_size[0], *space.shape), dtype=torch.float32)

    @property
    def time_limit(self) -> int | None:
        """Steps after which an episode is cut off, None where nothing does."""
        limits = (self._limit, shortest_limit(self._gym_envs[0]))
        return min((limit for limit in limits if limit is not None), default=None)

    def rand_action(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        """TorchRL's, and :func:`fill_unbounded` where a dimension lacks a bound."""
        drawn = super().rand_action(tensordict)
        if self._half_bounded:
            fill_unbounded(drawn.get("action"), self.action_spec)
        return drawn

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        # A copy: the caller may reuse the memory.
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
        """Resets simulators, each with its next episode's seed; the observations of all."""
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
        """Number of actions since the last reset of each simulator."""
        return self._steps

    def simulator_state(self) -> dict[str, Any]:
        """See :meth:`BatchedEnv.simulator_state`.

        Returns:
            Tensors and the seed: the episodes' numbers and lengths, the actions since the longest
            running episode began, ``(time, num_envs, ...)``, and the present observation.
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
        """See :meth:`BatchedEnv.restore_simulator`.

        A replay fails if the simulator does not repeat itself for the same seed and actions.
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
            _check_actions(actions, self.action_spec.shape, self._bounds, count)
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
        """Observation of copy ``i`` after ``actions``; None if its episode ended before them."""
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
        return np.asarray(observation, dtype=self._last_observation.dtype)

    def _restore_clocks(self, state: dict[str, Any]) -> None:
        """Restores what a subclass added to :meth:`simulator_state`."""

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Closes every copy."""
        if not self.is_closed:
            for env in self._gym_envs:
                env.close()
        super().close(raise_if_closed=raise_if_closed)


class GymImageEnv(GymVectorEnv):
    """A :class:`GymVectorEnv` of images, uint8 ``(channels, height, width)``.

    The batched environment of a family with images, see :func:`~giril_rl.envs.register_family`.

    Args:
        make_fn: as for :class:`GymVectorEnv`, with uint8 observations of three dimensions.
        num_envs: number of copies.
        seed: root of the episodes' seeds.
        use: what the episodes are for.
        max_episode_steps: as for :class:`GymVectorEnv`.

    Raises:
        UserError: as :class:`GymVectorEnv`, and for observations of another kind.
    """

    def _observation_spec(self, env: gymnasium.Env) -> TensorSpec:
        space = env.observation_space
        shape = space.shape if isinstance(space, gymnasium.spaces.Box) else ()
        if len(shape) != 3 or space.dtype != np.uint8:
            raise UserError(
                f"{env_name(env)} has observations of the kind {space}: a family of images needs "
                "uint8 (channels, height, width)."
            )
        return Bounded(0, 255, shape=(self.batch_size[0], *shape), dtype=torch.uint8)


def _check_actions(
    actions: np.ndarray,
    shape: Sequence[int],
    bounds: tuple[np.ndarray, np.ndarray] | None,
    count: int | None,
) -> None:
    """Refuses a saved history of actions that simulators cannot have had."""
    real = count is None
    if actions.shape[1:] != tuple(shape) or actions.dtype.kind != ("f" if real else "i"):
        raise ValueError("its actions are of another shape or type than this task's")
    inside = np.isfinite(actions) if real else (actions >= 0) & (actions < count)
    if bounds is not None:
        inside &= (actions >= bounds[0]) & (actions <= bounds[1])
    if not inside.all():
        raise ValueError("its actions are not ones of this task")
