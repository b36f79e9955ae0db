"""The decoder's layers against torch's own: values, gradients, weights and names."""

import pytest
import torch
from giril_rl.networks.upsampling import ChannelsLast, RowsTransposedConv, TransposedConv
from torch import nn

LAYERS = {
    "strided": lambda: (TransposedConv(3, 5, 3, stride=2), nn.ConvTranspose2d(3, 5, 3, stride=2)),
    "rows": lambda: (RowsTransposedConv(3, 4, 6), nn.ConvTranspose2d(3, 4, 6)),
    "rows, one channel": lambda: (RowsTransposedConv(3, 1, 2), nn.ConvTranspose2d(3, 1, 2)),
}


@pytest.mark.parametrize("name", LAYERS)
@pytest.mark.parametrize("size", [(7, 7), (3, 6), (8, 5)])
def test_values_and_gradients_are_those_of_torchs_layer(name, size):
    ours, theirs = (layer.double() for layer in LAYERS[name]())
    theirs.load_state_dict(ours.state_dict())
    x = torch.rand(2, 3, *size, dtype=torch.float64)
    x = x.contiguous(memory_format=torch.channels_last)
    inputs = [x.clone().requires_grad_() for _ in range(2)]
    outputs = [layer(x) for layer, x in zip((ours, theirs), inputs, strict=True)]
    torch.testing.assert_close(*outputs, rtol=1e-12, atol=1e-12)
    weight = torch.rand_like(outputs[0])
    for out in outputs:
        (out * weight).square().sum().backward()
    torch.testing.assert_close(*(x.grad for x in inputs), rtol=1e-12, atol=1e-12)
    for mine, other in zip(ours.parameters(), theirs.parameters(), strict=True):
        torch.testing.assert_close(mine.grad, other.grad, rtol=1e-12, atol=1e-12)


def test_channels_last_is_unflatten():
    x = torch.rand(2, 24)
    assert torch.equal(ChannelsLast(1, (4, 3, 2))(x), nn.Unflatten(1, (4, 3, 2))(x))


def test_gradients_of_gradients():
    layer = RowsTransposedConv(2, 3, 4).double()
    x = torch.rand(1, 2, 5, 4, dtype=torch.float64, requires_grad=True)

    def rows(x, weight):
        return torch.func.functional_call(layer, {"weight": weight, "bias": layer.bias}, (x,))

    weight = layer.weight.detach().requires_grad_()
    assert torch.autograd.gradcheck(rows, (x, weight))
    assert torch.autograd.gradgradcheck(rows, (x, weight))
