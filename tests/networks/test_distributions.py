import pytest
import torch
from torch.distributions import Categorical, Independent, Normal, OneHotCategorical

from giril_rl.networks.distributions import CategoricalActions, DiagonalGaussian, OneHotActions


def gaussian(*batch, size=3):
    mean = torch.randn(*batch, size, requires_grad=True)
    log_std = (0.5 * torch.randn(size)).requires_grad_()
    theirs = Independent(Normal(mean, log_std.exp()), 1)
    return DiagonalGaussian(mean, log_std), theirs, [mean, log_std]


def categorical(*batch, size=4):
    logits = (3 * torch.randn(*batch, size)).requires_grad_()
    return CategoricalActions(logits), Categorical(logits=logits), [logits]


def one_hot(*batch, size=4):
    logits = (3 * torch.randn(*batch, size)).requires_grad_()
    return OneHotActions(logits), OneHotCategorical(logits=logits), [logits]


@pytest.mark.parametrize("batch", [(), (7,), (2, 5)])
@pytest.mark.parametrize("kind", [gaussian, categorical, one_hot])
def test_log_prob_entropy_and_mode_are_torchs(kind, batch):
    ours, theirs, _ = kind(*batch)
    action = theirs.sample()
    assert ours.log_prob(action).shape == ours.entropy().shape == batch
    torch.testing.assert_close(ours.log_prob(action), theirs.log_prob(action))
    torch.testing.assert_close(ours.entropy(), theirs.entropy())
    assert torch.equal(ours.mode, theirs.mode)
    assert ours.sample().shape == action.shape
    assert ours.sample().dtype == (action.dtype if kind is gaussian else torch.int64)


def test_one_hot_draws_are_the_categoricals_of_the_same_random_numbers():
    logits = torch.randn(50, 4)
    torch.manual_seed(3)
    index = CategoricalActions(logits).sample()
    torch.manual_seed(3)
    drawn = OneHotActions(logits).sample()
    assert torch.equal(drawn, torch.nn.functional.one_hot(index, 4))
    assert torch.equal(
        OneHotActions(logits).log_prob(drawn.bool()), CategoricalActions(logits).log_prob(index)
    )


@pytest.mark.parametrize("kind", [gaussian, categorical, one_hot])
def test_gradients_are_torchs(kind):
    *both, leaves = kind(6)
    action = both[1].sample()
    ours, theirs = (
        torch.autograd.grad(d.log_prob(action).sum() + 0.3 * d.entropy().sum(), leaves)
        for d in both
    )
    torch.testing.assert_close(ours, theirs)


def test_gaussian_samples_have_its_moments():
    mean, log_std = torch.tensor([1.0, -2.0]), torch.tensor([-1.0, 0.7])
    draws = DiagonalGaussian(mean.expand(200_000, 2), log_std).sample()
    # The mean's own deviation is at most 2.01 / sqrt(200,000) = 0.0045.
    torch.testing.assert_close(draws.mean(0), mean, atol=0.02, rtol=0)
    torch.testing.assert_close(draws.std(0), log_std.exp(), atol=0.02, rtol=0)
    assert draws.T.corrcoef()[0, 1].abs() < 0.01


def test_categorical_samples_have_its_frequencies():
    logits = torch.tensor([0.0, 2.0, -1.0, 1.0])
    draws = CategoricalActions(logits.expand(200_000, 4)).sample()
    frequencies = draws.bincount(minlength=4) / len(draws)
    torch.testing.assert_close(frequencies, logits.softmax(-1), atol=0.005, rtol=0)


def test_impossible_actions_are_never_drawn():
    logits = torch.tensor([0.0, -torch.inf, 0.0]).expand(1000, 3)
    assert set(CategoricalActions(logits).sample().tolist()) == {0, 2}


@pytest.mark.parametrize("kind", [gaussian, categorical])
def test_samples_carry_no_gradient(kind):
    assert not kind(5)[0].sample().requires_grad
