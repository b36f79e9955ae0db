"""What all batched environments share: resets, episode seeds, and a state that can be restored."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Categorical, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase

from giril_rl.runs.randomness import Use, stream_seed


class BatchedEnv(EnvBase):
    """``num_envs`` simulators stepped as one TorchRL environment whose state can be restored.

    ``("next", "observation")`` at an episode's end is the true terminal observation; the reset
    observation appears only as the next step's ``"observation"``. Every episode (in Atari, every
    64th) has its own seed, derived from ``use``, ``seed``, the simulator's index and the episode's
    number. Replaying the actions since then rebuilds any moment of a run
    (:meth:`simulator_state`, :meth:`restore_simulator`).

    A subclass makes its simulators, calls :meth:`_declare` with its observation and action specs,
    sets ``_last_observation``, and defines ``_step``, ``_reset_where`` and the two methods that
    save and restore.

    Args:
        num_envs: number of simulators, the environment's batch size.
        seed: root of the episodes' seeds.
        use: what the episodes are for; two uses never share seeds.
    """

    _onward_key = "observation"
    """Entry of ``next`` from which a simulator continues when its episode has not ended."""

    has_threads = False
    """Whether each simulator runs in its own thread."""

    first_index = 0
    """Index of the first simulator, for seeds: above 0 where a larger environment is split."""

    _last_observation: np.ndarray

    def __init__(self, num_envs: int, *, seed: int = 0, use: Use = "training") -> None:
        super().__init__(device=None, batch_size=[num_envs])
        self.is_closed = False  # EnvBase says True where no wrapper says otherwise.
        self._root_seed, self._use = seed, use
        self._episode = np.zeros(num_envs, dtype=np.int64)
        self._restored = False
        self._false = torch.zeros(num_envs, 1, dtype=torch.bool)

    def _declare(self, observation: TensorSpec, action: TensorSpec) -> None:
        n = self.batch_size[0]
        self.observation_spec = Composite(observation=observation, shape=(n,))
        self.action_spec = action
        self.reward_spec = Unbounded((n, 1), dtype=torch.float32)
        flag = Categorical(2, shape=(n, 1), dtype=torch.bool)
        self.done_spec = Composite(
            done=flag.clone(), terminated=flag.clone(), truncated=flag.clone(), shape=(n,)
        )

    @property
    def time_limit(self) -> int | None:
        """Steps after which an episode is cut off, None where nothing does or it is not known."""
        return None

    def step_and_maybe_reset(
        self, tensordict: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        """Steps all simulators and resets those whose episode ended.

        Equals :meth:`torchrl.envs.EnvBase.step_and_maybe_reset` without its general bookkeeping,
        which costs more than fast simulators do.
        """
        after = self._step(tensordict)
        tensordict.set("next", after)
        done = after.get("done")
        if done.any():
            observation = torch.from_numpy(self._reset_where(done.view(-1).numpy()))
        else:
            observation = after.get(self._onward_key)
        return tensordict, self._root(observation)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if self._restored:
            # The first reset after a restore returns the middle of the restored episodes.
            self._restored = False
            return self._root(torch.from_numpy(self._last_observation.copy()))
        if mask is None:
            selected = np.ones(self.batch_size[0], dtype=bool)
        else:
            selected = mask.view(-1).numpy()
        return self._root(torch.from_numpy(self._reset_where(selected)))

    def _root(self, observation: torch.Tensor) -> TensorDictBase:
        return TensorDict(
            {
                "observation": observation,
                "done": self._false,
                "terminated": self._false,
                "truncated": self._false,
            },
            batch_size=self.batch_size,
        )

    @abstractmethod
    def _reset_where(self, mask: np.ndarray) -> np.ndarray:
        """Begins new episodes where ``mask`` is true; the observations of all simulators."""

    def _episode_seed(self, index: int) -> int:
        numbers = (self._root_seed, self.first_index + index, int(self._episode[index]))
        return stream_seed(self._use, *numbers, bits=32)

    def _set_seed(self, seed: int | None) -> None:
        self._root_seed = 0 if seed is None else seed
        self._episode[:] = 0

    @abstractmethod
    def simulator_state(self) -> dict[str, Any]:
        """What :meth:`restore_simulator` needs to bring another instance to this moment."""

    @abstractmethod
    def restore_simulator(self, state: dict[str, Any]) -> bool:
        """Replays the running episodes; the next :meth:`reset` continues them.

        Args:
            state: what :meth:`simulator_state` of an equal environment returned.

        Returns:
            Whether the replay reached the same moment; if not, all simulators begin new episodes.

        Raises:
            ValueError: if it is not a state of such an environment; nothing is played then.
        """


def saved_array(state: dict[str, Any], name: str, like: np.ndarray) -> np.ndarray:
    """A copy of an entry of a saved state, checked against dtype and shape of ``like``.

    Raises:
        ValueError: if it is anything else: the checkpoint may come from anybody.
    """
    found = saved_tensor(state, name)
    if found.dtype != like.dtype or found.shape != like.shape:
        raise ValueError(f"its {name!r} is not {like.dtype} of shape {list(like.shape)}")
    return found.copy()


def saved_tensor(state: dict[str, Any], name: str) -> np.ndarray:
    """An entry of a saved state that must be a tensor, not copied."""
    found = state.get(name)
    if not isinstance(found, torch.Tensor):
        raise ValueError(f"its {name!r} is not a tensor")
    return found.numpy()


def saved_seed(state: dict[str, Any]) -> int:
    """The root of the episodes' seeds in a saved state."""
    seed = state.get("seed")
    if type(seed) is not int or seed < 0:
        raise ValueError("its seed is not a natural number")
    return seed


def check_counts(name: str, counts: np.ndarray, least: int, most: int | None = None) -> None:
    """Refuses counts in a saved state that no simulator can have reached."""
    if (counts < least).any() or (most is not None and (counts > most).any()):
        span = f"at least {least}" if most is None else f"between {least} and {most}"
        raise ValueError(f"its {name!r} is not {span}")
