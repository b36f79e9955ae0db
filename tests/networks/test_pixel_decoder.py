import pytest
import torch
import torch.nn.functional as F
from torch import nn

from giril_rl.errors import UserError
from giril_rl.networks.pixel_decoder import (
    ChannelsLast,
    PixelDecoder,
    RowsTransposedConv,
    TransposedConv,
)


def frames(*batch, channels=4):
    return torch.rand(*batch, channels, 84, 84) * 2 - 1


@pytest.fixture
def decoder():
    decoder = PixelDecoder(5)
    with torch.no_grad():
        for parameter in decoder.parameters():  # biases are zero at first and would not be seen
            if parameter.ndim == 1:
                parameter.normal_(std=0.1)
    return decoder


def test_layers_are_those_of_the_paper_and_the_released_code():
    weights = [tuple(p.shape) for p in PixelDecoder(6).parameters() if p.ndim > 1]
    assert weights == [
        (64, 6),
        (1024, 64),
        (64, 64, 3, 3),
        (64, 64, 3, 3),
        (64, 32, 3, 3),
        (32, 32, 3, 3),
        (32, 4, 6, 6),
        (4, 8, 3, 3),
    ]


def test_by_hand(decoder):
    code, s = torch.randn(3, 5), frames(3)
    named = dict(decoder.painter.named_parameters())
    weights = [v for k, v in named.items() if k.endswith("weight")]
    biases = [v for k, v in named.items() if k.endswith("bias")]
    x = code
    for w, b in zip(weights[:2], biases[:2], strict=True):
        x = x @ w.T + b
        x = torch.where(x > 0, x, 0.01 * x)
    x, sides = x.reshape(3, 64, 4, 4), []
    for w, b in zip(weights[2:-1], biases[2:-1], strict=True):
        x = F.conv_transpose2d(x, w, b, stride=2)
        sides.append(x.shape[-1])
        x = torch.where(x > 0, x, 0.01 * x)
    assert sides == [9, 19, 39, 79]
    x = F.conv_transpose2d(x, weights[-1], biases[-1])
    torch.testing.assert_close(decoder.image(code), x)
    joined = F.pad(torch.cat((x, s), 1), (2, 2, 2, 2))
    expected = F.conv2d(joined, decoder.last.weight, decoder.last.bias, dilation=2)
    torch.testing.assert_close(decoder(code, s), expected)


@pytest.mark.parametrize("codes", [1, 8, 19])
def test_without_gradient_some_codes_are_painted_at_a_time(decoder, codes):
    code = torch.randn(codes, 5)
    with torch.no_grad():
        found = decoder.image(code)
    torch.testing.assert_close(found, decoder.image(code).detach(), rtol=1e-5, atol=1e-6)


def test_the_codes_part_has_a_gradient_where_one_is_wanted(decoder):
    code = torch.randn(2, 5, requires_grad=True)
    part = decoder.code_part(code)
    part.square().sum().backward()
    assert code.grad.abs().min() > 0
    with torch.no_grad():
        torch.testing.assert_close(decoder.code_part(code), part, rtol=1e-5, atol=1e-5)


def state_part(decoder, s):
    """What observations add to the prediction."""
    flat = s.reshape(-1, *s.shape[-3:])
    return F.conv2d(flat, decoder.state_weight, padding=2, dilation=2).reshape(s.shape)


def test_is_the_sum_of_its_two_parts(decoder):
    action, s = torch.tensor([[0, 3, 4], [1, 1, 2]]), frames(2, 3)
    whole = decoder(torch.eye(5)[action], s)
    parts = decoder.action_table()[action] + state_part(decoder, s)
    torch.testing.assert_close(parts, whole, rtol=1e-5, atol=1e-5)
    assert not torch.allclose(whole[0, 0], whole[0, 1] - state_part(decoder, s[0, 1] - s[0, 0]))


def test_all_parameters_get_gradients(decoder):
    decoder(torch.randn(2, 5), frames(2)).square().sum().backward()
    assert all(p.grad is not None and p.grad.any() for p in decoder.parameters())


@pytest.mark.parametrize("batch", [(), (2,), (2, 3), (0,)])
def test_any_leading_shape(decoder, batch):
    code, s = torch.randn(*batch, 5), frames(*batch)
    assert decoder.image(code).shape == decoder(code, s).shape == (*batch, 4, 84, 84)
    flat = decoder(code.reshape(-1, 5), s.reshape(-1, 4, 84, 84))
    torch.testing.assert_close(decoder(code, s).reshape(-1, 4, 84, 84), flat)


def test_another_number_of_channels():
    decoder = PixelDecoder(3, channels=1)
    s = frames(2, channels=1)
    whole = decoder(torch.eye(3)[[2, 0]], s)
    parts = decoder.action_table()[[2, 0]] + state_part(decoder, s)
    torch.testing.assert_close(parts, whole, rtol=1e-5, atol=1e-5)


def test_other_shapes_are_refused(decoder):
    with pytest.raises(UserError, match="84"):
        decoder(torch.zeros(2, 5), torch.zeros(2, 4, 64, 64))
    with pytest.raises(UserError, match="84"):
        decoder(torch.zeros(2, 5), torch.zeros(2, 1, 84, 84))


def test_initialisation_is_xavier_uniform():
    for layer in PixelDecoder(6).modules():
        if isinstance(layer, (nn.Linear, nn.Conv2d, nn.ConvTranspose2d)):
            area = layer.weight[0, 0].numel()
            limit = (6 / (area * sum(layer.weight.shape[:2]))) ** 0.5
            assert 0.95 * limit < layer.weight.abs().max().item() <= limit
            assert not layer.bias.any()


# The decoder's layers against torch's own: values, gradients, weights and names.

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
