"""Environments whose observation is their step counter, so that a shifted reward shows at once."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase


class CounterEnv(EnvBase):
    """Observation ``[index of the environment, step]``; environment i ends after 3 + i steps.

    The reward is whatever the test wants it to be. ``group`` nests observation, action and reward.
    """

    def __init__(self, num_envs=3, reward=lambda t: t, group=None, dtype=torch.float32):
        super().__init__(batch_size=[num_envs])
        n, self.group, self.reward_of, self.dtype_ = num_envs, group, reward, dtype
        observation = Composite(observation=Unbounded((n, 2)), shape=(n,))
        self.action_spec = self._nest(
            Composite(action=Bounded(-1, 1, shape=(n, 1)), shape=(n,)), composite=True
        )
        self.observation_spec = self._nest(observation, composite=True)
        self.reward_spec = self._nest(
            Composite(reward=Unbounded((n, 1), dtype=dtype), shape=(n,)), composite=True
        )
        flag = Categorical(2, shape=(n, 1), dtype=torch.bool)
        self.done_spec = Composite(done=flag, terminated=flag.clone(), shape=(n,))
        self.t = torch.zeros(n, 1)
        self.index = torch.arange(n, dtype=torch.float32).unsqueeze(-1)

    def _nest(self, value, composite=False):
        if self.group is None:
            return value
        if composite:
            return Composite({self.group: value}, shape=self.batch_size)
        return TensorDict({self.group: value}, self.batch_size)

    def _observe(self, **more):
        entries = {"observation": torch.cat((self.index, self.t), -1), **more}
        return self._nest(TensorDict(entries, self.batch_size))

    def _step(self, tensordict):
        self.t = self.t + 1
        done = self.t >= 3 + self.index
        reward = torch.as_tensor(self.reward_of(self.t)).expand_as(self.t).to(self.dtype_)
        out = self._observe(reward=reward.clone())
        return out.update({"done": done, "terminated": done.clone()})

    def _reset(self, tensordict=None, **kwargs):
        mask = None if tensordict is None else tensordict.get("_reset", None)
        self.t = torch.zeros_like(self.t) if mask is None else torch.where(mask, 0.0, self.t)
        done = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        return self._observe().update({"done": done, "terminated": done.clone()})

    def _set_seed(self, seed):
        pass


@pytest.fixture
def counter_env():
    return CounterEnv


@pytest.fixture
def keys():
    """Maps a group to the keys of observation, action and next observation."""

    def make(group=None):
        prefix = () if group is None else (group,)
        flat = [(*prefix, "observation"), (*prefix, "action"), ("next", *prefix, "observation")]
        return [key[0] if len(key) == 1 else key for key in flat]

    return make


@pytest.fixture
def policy(keys):
    """A deterministic policy, different in every environment and at every step."""

    def make(group=None):
        observation, action, _ = keys(group)
        return TensorDictModule(
            lambda o: torch.sin(o.sum(-1, keepdim=True) * 1.7), [observation], [action]
        )

    return make


@pytest.fixture
def telling(keys):
    """A reward that spells out which environment, step, action and next step it was made of."""

    def reward(s, a, following):
        index = s[..., :1]
        assert torch.equal(index, following[..., :1])
        return 1000 * index + 100 * s[..., 1:] + a + 10_000 * following[..., 1:]

    def make(group=None, out_key=("next", "intrinsic_reward")):
        return TensorDictModule(reward, keys(group), [out_key])

    return make
