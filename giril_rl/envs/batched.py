"""What every batched environment of a task has in common, whatever simulates it."""

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
    """``num_envs`` simulators stepped as one TorchRL environment that can be brought back.

    ``("next", "observation")`` at an episode's end is the true terminal observation; the reset
    observation appears only as the next step's ``"observation"``. Every episode (of games, every
    64th) has a seed of its own, made of ``use``, ``seed``, the simulator's index and the episode's
    number, so that any moment of a run can be rebuilt by replaying actions
    (:meth:`simulator_state`, :meth:`restore_simulator`).

    A subclass makes its simulators, calls :meth:`_declare` with its observation and action specs,
    and defines ``_step``, ``_reset_where`` and the two methods that save and restore.

    Args:
        num_envs: number of simulators, the environment's batch size.
        seed: root of the episodes' seeds.
        use: what the episodes are for; those of two uses never have equal seeds.
    """

    _onward_key = "observation"
    """Entry of ``next`` from which a simulator goes on whose episode has not ended."""

    has_threads = False
    """Whether the simulators run in threads of their own."""

    first_index = 0
    """The first simulator's number, of which episodes have their seeds; more than 0 where a larger
    environment is played in parts."""

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

    def step_and_maybe_reset(
        self, tensordict: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        """Steps all simulators and resets those whose episode ended.

        The same as :meth:`torchrl.envs.EnvBase.step_and_maybe_reset` without its general
        bookkeeping, which costs more than fast simulators do.
        """
        following = self._step(tensordict)
        tensordict.set("next", following)
        done = following.get("done")
        if done.any():
            observation = torch.from_numpy(self._reset_where(done.view(-1).numpy()))
        else:
            observation = following.get(self._onward_key)
        return tensordict, self._root(observation)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if self._restored:
            # A restored simulator stands in the middle of its episodes: the first reset after
            # that hands out where it stands.
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
        """Begins new episodes where ``mask`` says so; what all simulators then show."""

    def _episode_seed(self, index: int) -> int:
        numbers = (self._root_seed, self.first_index + index, int(self._episode[index]))
        return stream_seed(self._use, *numbers, bits=32)

    def _set_seed(self, seed: int | None) -> None:
        self._root_seed = 0 if seed is None else seed
        self._episode[:] = 0

    @abstractmethod
    def simulator_state(self) -> dict[str, Any]:
        """What :meth:`restore_simulator` needs to bring another instance to this very moment."""

    @abstractmethod
    def restore_simulator(self, state: dict[str, Any]) -> bool:
        """Replays the running episodes; the next :meth:`reset` hands out where they stand.

        Args:
            state: what :meth:`simulator_state` returned for an equal environment.

        Returns:
            Whether the replay came to the same moment; if not, all simulators begin new episodes.

        Raises:
            ValueError: if it is no state of such an environment; nothing is played then.
        """
