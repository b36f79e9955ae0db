"""The rewards that stand in for a learned one."""

import pytest
import torch
from reward_data import transition
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch.distributions import Gamma

from giril_rl.errors import UserError
from giril_rl.rewards import (
    AffineReward,
    ConstantReward,
    CopyReward,
    NoiseReward,
    ObservationScaler,
)


def test_a_constant():
    batch = ConstantReward()(TensorDict(batch_size=[3, 5]))
    assert torch.equal(batch["next", "intrinsic_reward"], torch.ones(3, 5, 1))
    batch = ConstantReward(-2.0, out_keys=(("a", "b"),))(TensorDict(batch_size=[]))
    assert batch["a", "b"].tolist() == [-2.0]


def test_the_copys_scaled_clamped_change_by_hand():
    scaler = ObservationScaler(2, rule="demo_range").fit(torch.tensor([[0.0, 0.0], [4.0, 20.0]]))
    s, s_next = torch.tensor([[[1.0, 10.0], [2.0, 5.0]], [[3.0, 90.0], [2.0, 5.0]]])
    out = CopyReward(scaler, scale=3.0)(transition(s, torch.zeros(2), s_next))
    # (-0.5, 0) to (0.5, 1), clamped from 8: 1 + 1; the second one stands still
    assert out["next", "intrinsic_reward"].tolist() == [[6.0], [0.0]]


def test_the_copys_dispatch_and_bad_keys():
    scaler = ObservationScaler(1, rule="raw", clamp=False)
    out = CopyReward(scaler)(observation=torch.tensor([1.0]), next_observation=torch.tensor([4.0]))
    assert out.tolist() == [9.0]
    with pytest.raises(UserError, match="two in_keys"):
        CopyReward(scaler, in_keys=["observation", "action", ("next", "observation")])


def draw(reward, *batch):
    return reward(TensorDict(batch_size=batch))["next", "intrinsic_reward"]


@pytest.mark.parametrize(("mean", "variance"), [(2.0, 0.5), (0.05, 0.01), (1e-3, 1e-8)])
def test_mean_variance_and_shape_of_a_gamma(mean, variance):
    drawn = draw(NoiseReward(mean, variance), 400, 500)
    assert drawn.shape == (400, 500, 1) and drawn.dtype == torch.float32
    assert (drawn > 0).all()
    assert drawn.double().mean().item() == pytest.approx(mean, rel=0.01)
    assert drawn.double().var().item() == pytest.approx(variance, rel=0.03)
    gamma = Gamma(torch.tensor(mean**2 / variance), torch.tensor(mean / variance))
    torch.manual_seed(0)
    quantiles = torch.tensor([0.25, 0.5, 0.75, 0.95])
    expected = gamma.sample((200_000,)).quantile(quantiles)
    torch.testing.assert_close(drawn.flatten().quantile(quantiles), expected, rtol=0.05, atol=0.0)


def test_draws_are_independent_of_each_other():
    drawn = draw(NoiseReward(1.0, 1.0), 100, 1000).squeeze(-1)
    for a, b in ((drawn[0], drawn[1]), (drawn[0, 1:], drawn[0, :-1])):
        assert abs(torch.corrcoef(torch.stack((a, b)))[0, 1]) < 0.1


def test_a_very_skewed_one_stays_positive():
    """At shape 1e-6 nearly every draw is smaller than the smallest float."""
    drawn = draw(NoiseReward(1e-3, 1.0), 10_000)
    assert (drawn > 0).all() and drawn.isfinite().all()


def test_noise_is_private_seeded_and_restored():
    before = torch.get_rng_state()
    one, two, other = (NoiseReward(1.0, 1.0, seed=seed) for seed in (3, 3, 4))
    first = draw(one, 8)
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.equal(draw(two, 8), first) and not torch.equal(draw(other, 8), first)
    state = one.state_dict()
    assert all(isinstance(v, torch.Tensor) for v in state.values())
    second = draw(one, 8)
    assert not torch.equal(second, first)
    fresh = NoiseReward(5.0, 2.0, seed=99)
    fresh.load_state_dict(state)
    assert torch.equal(draw(fresh, 8), second)


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf"), 1e-60])
def test_refuses_what_no_gamma_has(value):
    with pytest.raises(UserError, match="the noise's mean is"):
        NoiseReward(value, 1.0)
    with pytest.raises(UserError, match="the noise's variance is"):
        NoiseReward(1.0, value)


def test_an_affine_reward_by_hand():
    square = TensorDictModule(torch.square, ["a"], [("next", "r")])
    reward = AffineReward(square, -2.0, 0.5)
    assert reward.in_keys == ["a"] and reward.out_keys == [("next", "r")]
    batch = reward(TensorDict({"a": torch.tensor([[1.0], [3.0]])}, [2]))
    assert batch["next", "r"].tolist() == [[-1.5], [-17.5]]
    assert batch["next", "r"].dtype == torch.float32


def test_an_affine_reward_keeps_a_double_a_double():
    double = TensorDictModule(torch.square, ["a"], ["r"])
    batch = AffineReward(double, 1, 2)(TensorDict({"a": torch.ones(2, 1).double()}, [2]))
    assert batch["r"].dtype == torch.float64


def test_an_affine_rewards_numbers_are_saved():
    state = AffineReward(ConstantReward(3.0), -1.0, 0.25).state_dict()
    fresh = AffineReward(ConstantReward(3.0))
    fresh.load_state_dict(state)
    assert fresh(TensorDict(batch_size=[]))["next", "intrinsic_reward"].tolist() == [-2.75]


def test_what_an_affine_reward_refuses():
    with pytest.raises(UserError, match="scale=0"):
        AffineReward(ConstantReward(), 0.0)
    two = TensorDictModule(lambda a: (a, a), ["a"], ["x", "y"])
    with pytest.raises(UserError, match="writes"):
        AffineReward(two)
