import numpy as np
import pytest
import torch

from giril_rl.errors import UserError
from giril_rl.networks.normalise import RunningNormaliser


def chunks():
    generator = torch.Generator().manual_seed(0)
    shapes = [(5, 3), (2, 7, 3), (1, 3), (40, 3)]
    return [torch.randn(*s, generator=generator) * 4 + torch.tensor([1e3, 0, -7]) for s in shapes]


def test_statistics_are_those_of_all_data_together():
    normalise = RunningNormaliser(3)
    for chunk in chunks():
        normalise.update(chunk)
    data = np.concatenate([chunk.reshape(-1, 3).double().numpy() for chunk in chunks()])
    # The prior: 1e-4 observations of mean 0 and variance 1.
    count = len(data) + 1e-4
    mean = data.sum(0) / count
    var = (((data - mean) ** 2).sum(0) + 1e-4 * (1 + mean**2)) / count
    assert normalise.count.item() == pytest.approx(count)
    np.testing.assert_allclose(normalise.mean.numpy(), mean, rtol=1e-9)
    np.testing.assert_allclose(normalise.var.numpy(), var, rtol=1e-6)
    found = normalise(torch.from_numpy(data).float()).numpy()
    expected = np.clip((data - mean) / np.sqrt(var + 1e-8), -10, 10)
    np.testing.assert_allclose(found, expected, atol=1e-3)
    # And without the prior's trace, where the mean is not large.
    np.testing.assert_allclose(normalise.mean[1:].numpy(), data.mean(0)[1:], atol=1e-4)
    np.testing.assert_allclose(normalise.var[1:].numpy(), data.var(0)[1:], rtol=1e-3)


def test_chunks_do_not_matter():
    once, often = RunningNormaliser(3), RunningNormaliser(3)
    once.update(torch.cat([chunk.reshape(-1, 3) for chunk in chunks()]))
    for chunk in chunks():
        often.update(chunk)
    for name, value in once.state_dict().items():
        torch.testing.assert_close(often.state_dict()[name], value)


def test_nothing_changes_before_the_first_update():
    x = torch.tensor([[0.5, -3.0], [9.0, 0.0]])
    assert torch.equal(RunningNormaliser(2)(x), x)


def test_values_are_clipped_and_the_input_is_not():
    normalise = RunningNormaliser(1, clip=2.0)
    normalise.update(torch.tensor([[-1.0], [1.0]]))
    x = torch.tensor([[100.0], [-100.0], [0.5]])
    assert normalise(x)[:2].tolist() == [[2.0], [-2.0]]
    assert normalise(x)[2].item() == pytest.approx(0.5, abs=1e-3)
    assert x.tolist() == [[100.0], [-100.0], [0.5]]


def test_a_constant_dimension_stays_finite():
    normalise = RunningNormaliser(1)
    for _ in range(50):
        normalise.update(torch.full((1000, 1), 3.0))
    assert normalise(torch.tensor([[3.0]])).abs().item() < 0.1
    assert normalise(torch.tensor([[4.0]])).item() == 10.0


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_what_is_not_finite_is_named_and_not_learned(value):
    normalise = RunningNormaliser(3)
    normalise.update(torch.randn(20, 3))
    before = {name: kept.clone() for name, kept in normalise.state_dict().items()}
    batch = torch.randn(4, 7, 3)  # Environments, time.
    batch[2, 5, 1] = value
    for learn in (normalise.update, normalise.fit):
        with pytest.raises(UserError, match=rf"{value} at entry 1 of the one at \[2, 5\]"):
            learn(batch)
        for name, kept in normalise.state_dict().items():
            assert torch.equal(kept, before[name])


def test_using_it_is_not_learning_and_its_state_is_whole():
    normalise, copy = RunningNormaliser(3), RunningNormaliser(3)
    for chunk in chunks():
        normalise.update(chunk)
    before = {name: value.clone() for name, value in normalise.state_dict().items()}
    x = torch.randn(20, 3)
    first = normalise(x)
    for name, value in normalise.state_dict().items():
        assert torch.equal(value, before[name])
    copy.load_state_dict(before)
    assert torch.equal(copy(x), first)
    for each in (normalise, copy):
        each.update(x)
    assert torch.equal(copy.var, normalise.var)
