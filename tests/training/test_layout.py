"""On frames a convolution's gradient may lie in memory otherwise than its weights do.

torch's fused Adam reads both as the weights lie, without a word: each weight would take the step of
another one.
"""

import pytest
import torch
from frame_losses import CASES
from tensordict import TensorDict
from torch import nn

from giril_rl.graphs import TracedGradients


@pytest.mark.parametrize("name", CASES)
def test_every_weight_takes_its_own_step(name):
    torch.manual_seed(0)
    gradients, inputs = CASES[name](8)
    parameters = gradients.parameters
    twins = [nn.Parameter(p.detach().clone()) for p in parameters]
    gradients.step(inputs)
    for twin, parameter in zip(twins, parameters, strict=True):
        assert parameter.grad.stride() == parameter.stride()
        twin.grad = parameter.grad.clone()
    torch.optim.Adam(twins, lr=1e-3, fused=False, foreach=False).step()
    torch.optim.Adam(parameters, lr=1e-3, fused=True).step()
    for twin, parameter in zip(twins, parameters, strict=True):
        torch.testing.assert_close(parameter, twin, rtol=1e-5, atol=1e-7)


def test_a_gradient_with_channels_last_keeps_its_values():
    class Last(nn.Module):
        def __init__(self):
            super().__init__()
            self.weight = nn.Parameter(torch.randn(3, 2, 3, 3))

        def forward(self, batch):
            last = self.weight.contiguous(memory_format=torch.channels_last)
            convolved = nn.functional.conv2d(batch["x"], last)
            return TensorDict({"loss_a": convolved.square().sum()})

    module = Last()
    x = torch.randn(4, 2, 7, 7).contiguous(memory_format=torch.channels_last)
    (expected,) = torch.autograd.grad(module(TensorDict({"x": x}))["loss_a"], [module.weight])
    traced = TracedGradients(module, keys=["x"])
    traced._recorded = False  # As for a module of convolution layers.
    traced.step([x])
    assert module.weight.grad.is_contiguous()
    torch.testing.assert_close(module.weight.grad, expected)
