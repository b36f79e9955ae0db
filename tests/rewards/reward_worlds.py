"""Environments in which rewards are checked, whose episodes' true ends are known without them."""

import functools
from collections.abc import Callable

import gymnasium
import numpy as np
import pytest
import torch
from reward_cases import Case
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import EnvBase

from giril_rl.envs import AtariEnv, GymVectorEnv
from giril_rl.envs.atari_preprocessing import AtariGame

MakeEnv = Callable[..., gymnasium.Env]


class Counter:
    """The environment that observes (start, step, last action).

    Args:
        make_env: makes a single one.
        discrete: its kind of actions.
    """

    steps = 10

    def __init__(self, make_env: MakeEnv, discrete: bool) -> None:
        self.make_env, self.discrete = make_env, discrete
        self.played = self.play(self.env())
        assert 2 <= self.played["next", "done"].sum() <= 20

    def env(self) -> EnvBase:
        """A fresh batch of environments."""
        make = functools.partial(self.make_env, discrete=self.discrete)
        return GymVectorEnv(make, 4, seed=0, max_episode_steps=100)

    def play(self, env: EnvBase) -> TensorDict:
        """The same steps in each environment that :meth:`env` makes, with transforms or without."""
        policy = TensorDictModule(self.act, ["observation"], ["action"])
        return env.rollout(self.steps, policy, break_when_any_done=False)

    def act(self, observation: torch.Tensor) -> torch.Tensor:
        """An action that follows from the observation."""
        if self.discrete:
            return (7 * observation.abs().sum(-1)).long() % 3
        return torch.sin(3 * observation.sum(-1, keepdim=True))

    @functools.cached_property
    def true_next(self) -> torch.Tensor:
        """What each step of ``played`` led to."""
        start, step, _ = self.played["observation"].unbind(-1)
        action = self.played["action"].float().reshape(step.shape)
        return torch.stack((start, step + 1, action), -1)

    @functools.cached_property
    def next_start(self) -> torch.Tensor:
        """What a wrong environment would give for the step that ends an episode."""
        start, step, _ = self.played["observation"].unbind(-1)
        return torch.stack((start, torch.zeros_like(step), torch.zeros_like(step)), -1)


class Breakout(Counter):
    """Two games, from shortly before the first lost life until shortly after it."""

    before = 20
    steps = 6

    def __init__(self) -> None:
        pytest.importorskip("ale_py")
        env = AtariEnv("breakout", 2, seed=2)
        policy = TensorDictModule(self.act, ["observation"], ["action"])
        self.earlier = env.rollout(self.before, policy)
        self.state = env.simulator_state()
        self.played = self.play(self.env())
        self.ends = self.played["next", "done"].squeeze(-1)
        assert self.ends.sum(1).tolist() == [1, 1] and not self.ends[:, -1].any()

    def env(self) -> EnvBase:
        """Both games as they stand after the earlier steps."""
        env = AtariEnv("breakout", 2, seed=2)
        env.restore_simulator(self.state)
        return env

    def act(self, observation: torch.Tensor) -> torch.Tensor:
        """An action that follows from the frames."""
        return observation.flatten(1).long().sum(-1) % 4

    @functools.cached_property
    def true_next(self) -> torch.Tensor:
        """In the first life, the stacks of a plain game that is played the same actions."""
        following = self.played["next", "observation"].clone()
        fresh = AtariEnv("breakout", 2, seed=2)
        actions = torch.cat([self.earlier["action"], self.played["action"]], 1)
        for i, ends in enumerate(self.ends):
            game = AtariGame("breakout")
            game.reset(fresh._episode_seed(i))
            frames = [game.play(action).frame for action in (1, 2)][1:]
            last = int(ends.nonzero())
            frames += [game.play(int(a)).frame for a in actions[i, : self.before + last + 1]]
            for t in range(last + 1):
                end = self.before + t + 2
                following[i, t] = torch.from_numpy(np.stack(frames[end - 4 : end]))
        return following

    @functools.cached_property
    def next_start(self) -> torch.Tensor:
        """The stack from which the game goes on."""
        return self.played["observation"].roll(-1, 1)


@functools.cache
def _world(pixels: bool, discrete: bool, make_env: MakeEnv) -> Counter:
    return Breakout() if pixels else Counter(make_env, discrete)


def world_of(case: Case, make_env: MakeEnv) -> Counter:
    """The world for a reward's kind of observation and action; made once.

    Args:
        case: the reward.
        make_env: makes an environment of vectors.
    """
    return _world(case.pixels, case.discrete, make_env)
