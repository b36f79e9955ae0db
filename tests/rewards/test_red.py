import math

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded

from giril_rl.errors import UserError
from giril_rl.rewards.actions import ActionEncoder
from giril_rl.rewards.red import DistillationReward
from giril_rl.rewards.scaler import ObservationScaler


class Constant(nn.Module):
    """Two features, whatever it is called with."""

    def __init__(self, value):
        super().__init__()
        self.value = nn.Parameter(torch.tensor(value))

    def forward(self, observation, encoding):
        return self.value.expand(*observation.shape[:-1], 2)


def made(value):
    """An error of ``2 * value ** 2`` everywhere, and five pairs."""
    reward = DistillationReward(
        Constant(value),
        Constant(0.0),
        scaler=ObservationScaler(3, rule="raw"),
        actions=ActionEncoder(Bounded(-1, 1, shape=(1,))),
    )
    return reward, TensorDict({"observation": torch.zeros(5, 3), "action": torch.zeros(5, 1)}, [5])


@pytest.mark.parametrize("value", [1.0, 0.01, 10.0])  # The last is exp(-200), 0 as a float32.
def test_sigma_is_solved_for(value):
    reward, pairs = made(value)
    reward.calibrate(pairs, demo_reward=0.9)
    assert reward.sigma.item() == pytest.approx(-math.log(0.9) / (2 * value**2), rel=1e-5)
    torch.testing.assert_close(
        reward(pairs)["next", "intrinsic_reward"].detach(), torch.full((5, 1), 0.9)
    )


def test_a_demonstration_without_error_has_no_sigma():
    reward, pairs = made(0.0)
    with pytest.raises(UserError, match=r"no sigma gives .* 0\.9, .* set reward\.sigma\.$"):
        reward.calibrate(pairs)
    assert reward.sigma == 1.0
    with pytest.raises(UserError, match=r"^demo_reward=1\.0 is outside \(0, 1\)"):
        reward.calibrate(pairs, demo_reward=1.0)
