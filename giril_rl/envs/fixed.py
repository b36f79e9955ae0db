"""Episodes of fixed length: a failure does not end them, so that survival alone pays nothing."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import gymnasium
import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.data import Categorical

from giril_rl.envs.batched import saved_array
from giril_rl.envs.gym_api import env_name, shortest_limit
from giril_rl.envs.vector import GymVectorEnv
from giril_rl.errors import UserError
from giril_rl.runs.randomness import Use

AfterFailure = Literal["reset", "continue"]


class FixedHorizonEnv(GymVectorEnv):
    """A :class:`GymVectorEnv` whose episodes all last until the time limit, which truncates them.

    After a failure the simulator is reset without telling the learner (``after_failure="reset"``,
    ``done`` stays False), or continues from where it failed (``"continue"``), which PyBullet's
    simulators allow: a fallen pendulum hangs and swings.

    ``("next", "observation")`` is the true next observation, also at a hidden reset, where it is
    that of the failed state: a transition's reward must not see the jump. ``next`` has two more
    entries:

    - ``following_observation``, from which the simulator really continues. It differs from
      ``observation`` only at a hidden reset, where it is the reset observation. A learner must
      bootstrap from its value, as :class:`giril_rl.training.PPO` does.
    - ``scored``, whether the step belongs to an episode of the task itself: True up to and
      including the first failure since the horizon began. The sum of these rewards is the task's
      own score.

    Step it with :meth:`step_and_maybe_reset`, as collectors and ``rollout`` without a break do:
    TorchRL's ``step_mdp`` does not know of hidden resets.

    Args:
        make_fn: as for :class:`GymVectorEnv`.
        num_envs: number of copies.
        after_failure: "reset" or "continue".
        seed: root of the episodes' seeds; each hidden reset begins an episode with its own seed.
        use: what the episodes are for; two uses never share seeds.
        max_episode_steps: the horizon, unless the environment has a shorter limit; None takes that.

    Raises:
        UserError: as :class:`GymVectorEnv`, and without any time limit; at a step, if an
            environment truncates an episode by itself before the horizon.

    Examples:
        >>> make = lambda: gymnasium.make("CartPole-v1")
        >>> env = FixedHorizonEnv(make, num_envs=2, max_episode_steps=100)
        >>> batch = env.rollout(100, break_when_any_done=False)
        >>> batch["next", "done"][:, :-1].any().item(), batch["next", "done"][:, -1].all().item()
        (False, True)
        >>> jumps = batch["next", "observation"] != batch["next", "following_observation"]
        >>> jumps.any().item(), batch["next", "terminated"].any().item()
        (True, False)
    """

    _onward_key = "following_observation"

    def __init__(
        self,
        make_fn: Callable[[], gymnasium.Env],
        num_envs: int,
        *,
        after_failure: AfterFailure = "reset",
        seed: int = 0,
        use: Use = "training",
        max_episode_steps: int | None = None,
    ) -> None:
        super().__init__(make_fn, num_envs, seed=seed, use=use, max_episode_steps=max_episode_steps)
        # A limit below another wrapper would restart at each hidden reset.
        limits = (self._limit, shortest_limit(self._gym_envs[0]))
        known = [limit for limit in limits if limit is not None]
        if not known:
            raise UserError(
                "an environment without a time limit has no fixed horizon: "
                "set task.max_episode_steps."
            )
        self._limit = self._horizon = min(known)
        self._failure_ends = after_failure == "reset"
        self._played = np.zeros(num_envs, dtype=np.int64)
        self._failed = np.zeros(num_envs, dtype=bool)

    def _make_specs(self, env: gymnasium.Env) -> None:
        super()._make_specs(env)
        shape = (self.batch_size[0], 1)
        self.observation_spec["following_observation"] = self.observation_spec[
            "observation"
        ].clone()
        self.observation_spec["scored"] = Categorical(2, shape=shape, dtype=torch.bool)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        after = super()._step(tensordict)
        self._played += 1
        self._check_horizon(after.get("truncated").view(-1).numpy())
        scored = torch.from_numpy(~self._failed).unsqueeze(-1)
        failed = after.get("terminated").view(-1).numpy()
        self._failed |= failed
        following = after.get("observation")
        if self._failure_ends and failed.any():
            following = torch.from_numpy(self._restart(failed))
        after.set("following_observation", following)
        after.set("scored", scored)
        after.set("terminated", self._false.clone())
        after.set("done", after.get("truncated").clone())
        return after

    def _check_horizon(self, cut: np.ndarray) -> None:
        early = cut & (self._steps < self._horizon)
        if early.any():
            steps = int(self._played[early][0])
            raise UserError(
                f"{env_name(self._gym_envs[0])} truncates an episode by itself after {steps} "
                f"steps, and the horizon is {self._horizon}: set task.max_episode_steps={steps}."
            )

    def _root(self, observation: torch.Tensor) -> TensorDictBase:
        root = super()._root(observation)
        root.set("following_observation", observation)
        root.set("scored", torch.from_numpy(~self._failed).unsqueeze(-1))
        return root

    def _reset_where(self, mask: np.ndarray) -> np.ndarray:
        self._failed[mask] = False
        return super()._reset_where(mask)

    def _restart(self, mask: np.ndarray) -> np.ndarray:
        self._played[mask] = 0
        return super()._restart(mask)

    def _replayed(self) -> np.ndarray:
        return self._played

    def simulator_state(self) -> dict[str, Any]:
        """As :meth:`GymVectorEnv.simulator_state`, with the clocks of hidden resets.

        The actions are those since the last reset of a simulator, hidden ones included.
        """
        return {
            **super().simulator_state(),
            "played": torch.from_numpy(self._played.copy()),
            "failed": torch.from_numpy(self._failed.copy()),
        }

    def _restore_clocks(self, state: dict[str, Any]) -> None:
        self._played = saved_array(state, "played", self._played)
        self._failed = saved_array(state, "failed", self._failed)
