import copy

import pytest
import torch
from giril_rl.networks.pixel_discriminators import PixelBottleneck, PixelDiscriminator
from torch import nn

from giril_rl.errors import UserError


def frames(*batch, channels=4):
    return torch.rand(*batch, channels, 84, 84) * 2 - 1


def literal(network, observation, code):
    """The network on the planes themselves."""
    planes = code[..., None, None].expand(*code.shape, 84, 84)
    layers = nn.Sequential(network.first, *network.rest, *network.head)
    return layers(torch.cat((observation, planes), 1))


CASES = {
    "discriminator": (PixelDiscriminator(6), 1),
    "two numbers": (PixelDiscriminator(6, out_features=2), 2),
    "bottleneck": (PixelBottleneck(6, latent=8), 16),
}


@pytest.fixture(params=CASES)
def case(request):
    network, size = CASES[request.param]
    return copy.deepcopy(network), size


@pytest.mark.parametrize("one_hot", [True, False])
@pytest.mark.parametrize("training", [True, False])
def test_equals_the_literal_planes(case, one_hot, training):
    network, size = case
    network.double().train(training)
    with torch.no_grad():
        network.first.bias.normal_()
    other = copy.deepcopy(network)
    s = frames(5).double().requires_grad_()
    code = (torch.eye(6)[[0, 5, 2, 2, 1]] if one_hot else torch.randn(5, 6)).double()
    code.requires_grad_()
    out, expected = network(s, code), literal(other, s, code)
    assert out.shape == (5, size)
    torch.testing.assert_close(out, expected)
    weights = torch.randn(5, size).double()
    grads = torch.autograd.grad((out * weights).sum(), [s, code, *network.parameters()])
    others = torch.autograd.grad((expected * weights).sum(), [s, code, *other.parameters()])
    for grad, wanted in zip(grads, others, strict=True):
        torch.testing.assert_close(grad, wanted, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3), (0,)])
def test_any_leading_shape(case, batch):
    network, size = case
    network.eval()
    s, code = frames(*batch), torch.randn(*batch, 6)
    out = network(s, code)
    assert out.shape == (*batch, size)
    flat = network(s.reshape(-1, 4, 84, 84), code.reshape(-1, 6))
    torch.testing.assert_close(out.reshape(-1, size), flat)


def test_first_and_last_layers():
    discriminator, bottleneck = PixelDiscriminator(6), PixelBottleneck(6, 8)
    assert discriminator.first.weight.shape == (32, 10, 3, 3)
    assert discriminator.head[-1].weight.shape == (1, 1024)
    assert bottleneck.head[0].weight.shape == (16, 64, 4, 4)


def test_another_number_of_channels():
    out = PixelDiscriminator(6, channels=1)(frames(2, channels=1), torch.eye(6)[:2])
    assert out.shape == (2, 1)


def test_other_shapes_are_refused(case):
    with pytest.raises(UserError, match="84"):
        case[0](torch.zeros(2, 4, 42, 42), torch.zeros(2, 6))
