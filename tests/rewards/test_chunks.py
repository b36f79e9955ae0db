import pytest
import torch
from giril_rl.rewards.chunks import in_chunks


class Weighted:
    """``sum(x) * y`` of each element, and the leading shapes that it was called with."""

    def __init__(self):
        self.shapes = []

    def __call__(self, x, y):
        self.shapes.append(tuple(y.shape))
        return x.sum((-2, -1)) * y


def data(*batch):
    x = torch.arange(6.0 * torch.Size(batch).numel()).reshape(*batch, 2, 3)
    return x, torch.randn(batch)


@pytest.mark.parametrize(
    ("batch", "size", "shapes"),
    [
        ((7,), None, [(7,)]),
        ((7,), 7, [(7,)]),
        ((7,), 3, [(3,), (3,), (1,)]),
        ((2, 3), 6, [(2, 3)]),
        ((2, 3), 4, [(4,), (2,)]),
        ((2, 2, 2), 5, [(5,), (3,)]),
        ((), 1, [()]),
        ((0,), 4, [(0,)]),
    ],
)
def test_the_same_numbers_in_the_order_of_the_batch(batch, size, shapes):
    function, (x, y) = Weighted(), data(*batch)
    out = in_chunks(function, (x, y), torch.Size(batch), size)
    assert function.shapes == shapes
    assert out.shape == batch
    assert torch.equal(out, x.sum((-2, -1)) * y)


def test_gradients_pass():
    x, y = data(5)
    y.requires_grad_()
    in_chunks(Weighted(), (x, y), torch.Size([5]), 2).sum().backward()
    assert torch.equal(y.grad, x.sum((-2, -1)))


def test_inputs_that_are_not_contiguous():
    x, y = data(3, 2)
    x, y = x.transpose(0, 1), y.T
    out = in_chunks(Weighted(), (x, y), torch.Size([2, 3]), 4)
    assert torch.equal(out, x.sum((-2, -1)) * y)
