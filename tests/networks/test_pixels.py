import copy

import pytest
import torch
import torch.nn.functional as F
from torch import nn

from giril_rl.errors import UserError
from giril_rl.networks.pixels import (
    ForwardModel,
    InverseModel,
    PixelBottleneck,
    PixelDiscriminator,
    PixelEncoder,
    PixelFeatures,
    conv_stack,
)


def frames(*batch, channels=4):
    return torch.rand(*batch, channels, 84, 84) * 2 - 1


def shapes(module):
    return [tuple(p.shape) for p in module.parameters() if p.ndim > 1]


def test_convolutions_are_those_of_the_paper():
    stack = conv_stack(8)
    assert [type(layer) for layer in stack] == [nn.Conv2d, nn.BatchNorm2d, nn.LeakyReLU] * 4 + [
        nn.Flatten
    ]
    assert shapes(stack) == [(32, 8, 3, 3), (32, 32, 3, 3), (64, 32, 3, 3), (64, 64, 3, 3)]
    x, sides = frames(2, channels=8), []
    for layer in stack:
        x = layer(x)
        if isinstance(layer, nn.Conv2d):
            sides.append(x.shape[-1])
    assert sides == [41, 20, 9, 4]


def test_convolutions_by_hand_in_eval_mode():
    stack = conv_stack(4)
    for layer in stack:
        if isinstance(layer, nn.BatchNorm2d):
            layer.running_mean.normal_()
            layer.running_var.uniform_(0.5, 2)
    stack.eval()
    x = y = frames(3)
    for conv, norm in zip(stack[0:12:3], stack[1:12:3], strict=True):
        y = F.conv2d(y, conv.weight, conv.bias, stride=2)
        mean, var = (v[:, None, None] for v in (norm.running_mean, norm.running_var))
        y = (y - mean) / (var + 1e-5).sqrt()
        y = torch.maximum(y, 0.01 * y)
    torch.testing.assert_close(stack(x), y.flatten(1))


def test_initialisation_is_xavier_uniform():
    encoder = PixelEncoder(6)
    for layer in encoder.modules():
        if isinstance(layer, nn.Conv2d):
            area = 9
            limit = (6 / (area * (layer.in_channels + layer.out_channels))) ** 0.5
        elif isinstance(layer, nn.Linear):
            limit = (6 / (1024 + 6)) ** 0.5  # that of either half
        else:
            continue
        largest = layer.weight.abs().max().item()
        assert 0.97 * limit < largest <= limit
        assert not layer.bias.any()


@pytest.mark.parametrize("batch", [(), (3,), (2, 3), (0,)])
def test_any_leading_shape(batch):
    encoder, features = PixelEncoder(6).eval(), PixelFeatures().eval()
    s, following = frames(*batch), frames(*batch)
    assert encoder(s, following).shape == (*batch, 12)
    assert features(s).shape == (*batch, 1024)
    flat = encoder(s.reshape(-1, 4, 84, 84), following.reshape(-1, 4, 84, 84))
    torch.testing.assert_close(encoder(s, following).reshape(-1, 12), flat)


def test_encoder_tells_the_two_observations_apart():
    encoder = PixelEncoder(6).eval()
    s, following = frames(2), frames(2)
    joined = encoder.head(encoder.body(torch.cat((s, following), 1)))
    torch.testing.assert_close(encoder(s, following), joined)
    assert not torch.allclose(encoder(s, following), encoder(following, s))


def test_another_number_of_channels():
    assert PixelEncoder(6, channels=1)(frames(2, channels=1), frames(2, channels=1)).shape == (
        2,
        12,
    )
    assert PixelFeatures(channels=3)(frames(2, channels=3)).shape == (2, 1024)


@pytest.mark.parametrize("shape", [(2, 4, 64, 64), (2, 4, 84, 83), (2, 3, 84, 84), (84, 84), ()])
def test_other_shapes_are_refused(shape):
    with pytest.raises(UserError, match=r"\(\*batch, 4, 84, 84\)"):
        PixelFeatures()(torch.zeros(shape))
    with pytest.raises(UserError, match="resize"):
        PixelEncoder(6)(frames(2), torch.zeros(shape))


def test_curiosity_models_are_those_of_the_paper():
    inverse, forward = InverseModel(6), ForwardModel(6)
    assert shapes(inverse) == [(64, 2048), (6, 64)]
    assert shapes(forward) == [(64, 1030), (1024, 64)]
    phi, following, code = torch.randn(5, 1024), torch.randn(5, 1024), torch.eye(6)[:5]
    for model, inputs in ((inverse, (phi, following)), (forward, (phi, code))):
        first, second = model[0], model[2]
        hidden = torch.cat(inputs, 1) @ first.weight.T + first.bias
        hidden = torch.where(hidden > 0, hidden, 0.01 * hidden)
        torch.testing.assert_close(model(*inputs), hidden @ second.weight.T + second.bias)


# Discriminators


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
def test_any_leading_shape_of_pairs(case, batch):
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


def test_another_number_of_channels_of_pairs():
    out = PixelDiscriminator(6, channels=1)(frames(2, channels=1), torch.eye(6)[:2])
    assert out.shape == (2, 1)


def test_other_shapes_of_pairs_are_refused(case):
    with pytest.raises(UserError, match="84"):
        case[0](torch.zeros(2, 4, 42, 42), torch.zeros(2, 6))
