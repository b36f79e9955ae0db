import pytest
import torch
from tensordict import TensorDict

from giril_rl.errors import UserError
from giril_rl.rewards import CopyReward, ObservationScaler


def test_the_scaled_clamped_change_by_hand():
    scaler = ObservationScaler(2, rule="demo_range").fit(torch.tensor([[0.0, 0.0], [4.0, 20.0]]))
    batch = TensorDict(
        {
            "observation": torch.tensor([[1.0, 10.0], [2.0, 5.0]]),
            "next": {"observation": torch.tensor([[3.0, 90.0], [2.0, 5.0]])},
        },
        [2],
    )
    out = CopyReward(scaler, scale=3.0)(batch)
    # (-0.5, 0) to (0.5, 1), clamped from 8: 1 + 1; the second one stands still
    assert out["next", "intrinsic_reward"].tolist() == [[6.0], [0.0]]


def test_dispatch_and_bad_keys():
    scaler = ObservationScaler(1, rule="raw", clamp=False)
    out = CopyReward(scaler)(observation=torch.tensor([1.0]), next_observation=torch.tensor([4.0]))
    assert out.tolist() == [9.0]
    with pytest.raises(UserError, match="two in_keys"):
        CopyReward(scaler, in_keys=["observation", "action", ("next", "observation")])
