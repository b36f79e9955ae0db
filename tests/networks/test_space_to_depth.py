import pytest
import torch
import torch.nn.functional as F

from giril_rl.errors import UserError
from giril_rl.networks.space_to_depth import SpaceToDepthConv, deal


@pytest.mark.parametrize(
    ("channels", "kernel", "stride"), [(4, 8, 4), (1, 4, 2), (3, 6, 3), (2, 4, 1)]
)
def test_values_and_gradients_are_those_of_the_plain_convolution(channels, kernel, stride):
    conv = SpaceToDepthConv(channels, 5, kernel, stride=stride).double()
    frames = torch.randint(0, 256, (3, channels, 84, 84), dtype=torch.uint8)
    weight, bias = (x.detach().clone().requires_grad_() for x in (conv.weight, conv.bias))
    plain = F.conv2d(frames.double() / 255, weight, bias, stride=stride)
    torch.testing.assert_close(conv(deal(frames, stride)), plain)
    wanted = torch.randn_like(plain)
    (plain * wanted).sum().backward()
    (conv(deal(frames, stride)) * wanted).sum().backward()
    torch.testing.assert_close(conv.weight.grad, weight.grad)
    torch.testing.assert_close(conv.bias.grad, bias.grad)


def test_weights_go_by_the_plain_convolutions_names():
    plain = torch.nn.Conv2d(4, 32, 8, stride=4)
    conv = SpaceToDepthConv(4, 32, 8, stride=4)
    conv.load_state_dict(plain.state_dict())
    frames = torch.randint(0, 256, (2, 4, 84, 84), dtype=torch.uint8)
    torch.testing.assert_close(conv(deal(frames, 4)), plain(frames / 255), atol=1e-5, rtol=1e-4)


def test_a_kernel_that_is_no_multiple_of_the_stride_is_refused():
    with pytest.raises(UserError, match="a kernel of 3 is no multiple of the stride 2"):
        SpaceToDepthConv(4, 32, 3, stride=2)
