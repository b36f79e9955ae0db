import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Gamma

from giril_rl.errors import UserError
from giril_rl.rewards import NoiseReward


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
