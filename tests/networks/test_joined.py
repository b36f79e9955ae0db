import torch
from giril_rl.networks.joined import JoinedSequential
from torch import nn


def test_is_the_plain_sequence_on_concatenated_inputs():
    layers = [nn.Linear(5, 3), nn.Tanh(), nn.Linear(3, 2)]
    joined, plain = JoinedSequential(*layers), nn.Sequential(*layers)
    assert list(joined.state_dict()) == list(plain.state_dict())
    x, y = torch.randn(2, 7, 4), torch.randn(2, 7, 1)
    assert torch.equal(joined(x, y), plain(torch.cat((x, y), -1)))
    assert torch.equal(joined(torch.cat((x, y), -1)), joined(x, y))
