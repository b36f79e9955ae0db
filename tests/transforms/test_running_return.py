import numpy as np
import pytest
import torch

from giril_rl.transforms import discounted_filter, running_moments


def loop_filter(reward, done, carry, gamma):
    out, carry = np.empty_like(reward), carry.copy()
    for t in range(reward.shape[1]):
        carry = gamma * carry + reward[:, t]
        out[:, t] = carry
        if done is not None:
            carry = np.where(done[:, t], 0.0, carry)
    return out, carry


def test_filter_by_hand():
    reward = torch.tensor([[1.0, 1.0, 1.0, 1.0]])
    done = torch.tensor([[False, True, False, True]])
    values, carry = discounted_filter(reward, done, torch.tensor([2.0]), 0.5)
    assert values.tolist() == [[2.0, 2.0, 1.0, 1.5]] and carry.tolist() == [0.0]


@pytest.mark.parametrize("gamma", [0.0, 0.5, 0.99, 1.0])
@pytest.mark.parametrize("steps", [1, 127, 128, 129, 700])
@pytest.mark.parametrize("ends", [None, 0.0, 0.02, 0.5, 1.0])
def test_filter_against_a_loop(gamma, steps, ends):
    rng = np.random.default_rng(0)
    reward, carry = rng.normal(3, 2, (4, steps)), rng.normal(0, 50, 4)
    done = None if ends is None else rng.random((4, steps)) < ends
    expected, expected_carry = loop_filter(reward, done, carry, gamma)
    values, new = discounted_filter(
        torch.from_numpy(reward),
        None if done is None else torch.from_numpy(done),
        torch.from_numpy(carry),
        gamma,
    )
    np.testing.assert_allclose(values.numpy(), expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(new.numpy(), expected_carry, rtol=1e-9, atol=1e-9)


def test_empty_batch():
    empty, carry = torch.zeros(3, 0), torch.ones(3)
    values, new = discounted_filter(empty, None, carry, 0.9)
    assert values.shape == (3, 0) and torch.equal(new, carry)
    one = torch.tensor(1.0)
    assert all(m.shape == (0,) for m in running_moments(empty, one, one, one))


@pytest.mark.parametrize("level", [0.0, 1e6])
def test_moments_against_numpy(level):
    values = level + np.random.default_rng(1).normal(0, 1, (3, 40))
    old, new = torch.from_numpy(values[:, :10]), torch.from_numpy(values[:, 10:])
    zero = torch.tensor(0.0, dtype=torch.float64)
    counts, means, m2s = running_moments(old, zero, zero, zero)
    counts, means, m2s = running_moments(new, counts[-1], means[-1], m2s[-1])
    for i in (0, 7, 29):
        seen = values[:, : 11 + i]
        assert counts[i] == seen.size
        np.testing.assert_allclose(means[i], seen.mean(), rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(m2s[i] / counts[i], seen.var(), rtol=1e-6)
