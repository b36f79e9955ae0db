import torch
from torch import nn

from giril_rl.networks.vectors import mlp


def test_layers_are_those_of_the_paper():
    kinds = [type(layer) for layer in mlp(5, 2)]
    assert kinds == [nn.Linear, nn.Tanh, nn.Linear, nn.Tanh, nn.Linear]
    shapes = [tuple(p.shape) for p in mlp(5, 2).parameters()]
    assert shapes == [(100, 5), (100,), (100, 100), (100,), (2, 100), (2,)]


def test_value_by_hand():
    network = mlp(1, 1, [1])
    with torch.no_grad():
        for parameter, value in zip(network.parameters(), (2.0, 1.0, 3.0, -0.5), strict=True):
            parameter.fill_(value)
    expected = 3 * torch.tanh(torch.tensor(2 * 0.25 + 1)) - 0.5
    torch.testing.assert_close(network(torch.tensor([[0.25]])), expected.reshape(1, 1))


def test_no_hidden_layer_is_a_linear_map():
    assert [type(layer) for layer in mlp(4, 2, [])] == [nn.Linear]


def test_several_inputs_are_concatenated():
    network = mlp(5, 2, [3])
    assert list(network.state_dict()) == ["0.weight", "0.bias", "2.weight", "2.bias"]
    x, y = torch.randn(7, 4), torch.randn(7, 1)
    assert torch.equal(network(x, y), network(torch.cat((x, y), -1)))
