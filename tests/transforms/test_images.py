"""Observations of bytes: in an environment, in workers, on batches and in a buffer."""

import gymnasium
import numpy as np
import pytest
import torch
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, GymWrapper, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from giril_rl.rewards import CopyReward, PixelScaler
from giril_rl.transforms import IntrinsicReward, ReturnScaling, WeightedReward


class Snow(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(0, 255, (2, 10, 8), np.uint8)
    action_space = gymnasium.spaces.Discrete(3)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self._frame(), {}

    def step(self, action):
        self.steps += 1
        return self._frame(), 1.0, self.steps == 4, False, {}

    def _frame(self):
        return self.np_random.integers(256, size=(2, 10, 8), dtype=np.uint8)


def make_env():
    return GymWrapper(Snow())


def stack():
    parts = IntrinsicReward(CopyReward(PixelScaler())), ReturnScaling()
    return Compose(*parts, WeightedReward({"reward": 0.8, "extrinsic_reward": 0.2}))


def expected(data):
    scaled = [x.float() / 127.5 - 1 for x in (data["observation"], data["next", "observation"])]
    return (scaled[1] - scaled[0]).square().sum((-1, -2, -3)).unsqueeze(-1)


@pytest.mark.parametrize("placement", ["alone", "inside", "outside"])
def test_in_an_environment(placement):
    def reward():
        return IntrinsicReward(CopyReward(PixelScaler()))

    env = {
        "alone": lambda: TransformedEnv(make_env(), reward()),
        "inside": lambda: SerialEnv(2, lambda: TransformedEnv(make_env(), reward())),
        "outside": lambda: TransformedEnv(SerialEnv(2, make_env), reward()),
    }[placement]()
    check_env_specs(env)
    data = env.rollout(10, break_when_any_done=False)
    assert data["observation"].dtype == torch.uint8 and data["next", "done"].any()
    torch.testing.assert_close(data["next", "reward"], expected(data))


def test_stack_on_batches_of_any_shape_and_in_a_buffer():
    data = SerialEnv(2, make_env).rollout(12, break_when_any_done=False)
    for shape in [(2, 12), (24,), (2, 3, 4)]:
        out = stack()(data.reshape(shape).clone())
        assert out["next", "reward"].shape == (*shape, 1)
        scaled = ReturnScaling()(IntrinsicReward(CopyReward(PixelScaler()))(data.reshape(shape)))
        total = 0.8 * scaled["next", "reward"] + 0.2
        torch.testing.assert_close(out["next", "reward"], total)
        data["next", "reward"] = torch.ones(2, 12, 1)
    transform = IntrinsicReward(CopyReward(PixelScaler()))
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(24), transform=transform, batch_size=7
    )
    buffer.extend(data.reshape(-1))
    sample = buffer.sample()
    torch.testing.assert_close(sample["next", "reward"], expected(sample))
