import pytest
import torch
import torch.nn.functional as F

from giril_rl.networks.pixel_decoder import PixelDecoder
from giril_rl.rewards.factored import factored_error

ACTIONS = 4


@pytest.fixture
def decoder():
    decoder = PixelDecoder(ACTIONS)
    with torch.no_grad():
        for parameter in decoder.parameters():
            if parameter.ndim == 1:
                parameter.normal_(std=0.3)
        decoder.last.weight.mul_(4)  # the prediction leaves [-1, 1] here and there
    return decoder


def transitions(*batch, channels=4):
    shape = (*batch, channels, 84, 84)
    observation, following = (torch.randint(256, shape, dtype=torch.uint8) for _ in range(2))
    return torch.randint(ACTIONS, batch), observation, following


def scale(frames):
    return frames.float() / 127.5 - 1


@torch.no_grad()
def literal_error(decoder, action, observation, following, clamp):
    """Eq. 2 with the whole decoder run for each transition."""
    predicted = decoder(torch.eye(ACTIONS)[action], scale(observation))
    if clamp:
        predicted = predicted.clamp(-1, 1)
    return (predicted - scale(following)).double().square().sum((-3, -2, -1)).float()


def parts(decoder):
    return decoder.action_table(), decoder.state_weight


@pytest.mark.parametrize("clamp", [True, False])
@pytest.mark.parametrize("chunk", [1, 3, 7, 100])
def test_equals_the_literal_decoder(decoder, clamp, chunk):
    data = transitions(7)
    error = factored_error(*parts(decoder), *data, clamp=clamp, chunk=chunk)
    expected = literal_error(decoder, *data, clamp)
    torch.testing.assert_close(error, expected, rtol=1e-5, atol=0)
    assert not error.requires_grad


def test_the_clamp_matters_here(decoder):
    data = transitions(3)
    clamped, free = (factored_error(*parts(decoder), *data, clamp=x) for x in (True, False))
    assert (clamped < 0.9 * free).all()


def test_each_pixel_by_hand():
    """One pixel of s differs from mid-grey's neighbours: nine taps of dilation 2 see it."""
    weight = torch.zeros(1, 1, 3, 3)
    weight[0, 0] = torch.arange(9.0).reshape(3, 3) / 16
    table = torch.zeros(2, 1, 84, 84)
    table[1] = 0.25
    for row, column in ((40, 41), (0, 0), (83, 2), (1, 83)):
        s = torch.full((1, 1, 84, 84), 255, dtype=torch.uint8)
        s[..., row, column] = 0
        expected = torch.zeros(84, 84)
        for y in range(3):
            for x in range(3):
                # The state is 1 within the frame and 0 beyond it, but -1 at the one pixel.
                shifted = torch.zeros(84, 84)
                rows, columns = range(84), range(84)
                inside = torch.tensor(
                    [
                        [0 <= r + 2 * y - 2 < 84 and 0 <= c + 2 * x - 2 < 84 for c in columns]
                        for r in rows
                    ]
                )
                shifted[inside] = 1
                r, c = row - 2 * y + 2, column - 2 * x + 2
                if 0 <= r < 84 and 0 <= c < 84:
                    shifted[r, c] = -1
                expected += weight[0, 0, y, x] * shifted
        black = torch.zeros_like(s)  # scaled -1
        for action in (0, 1):
            wanted = ((expected + 0.25 * action).clamp(-1, 1) + 1).double().square().sum()
            error = factored_error(table, weight, torch.tensor([action]), s, black)
            assert error.item() == pytest.approx(wanted.item(), rel=1e-5)


def test_small_errors_are_not_lost():
    """A prediction that is right but for one pixel, by one 255th."""
    weight = torch.zeros(4, 4, 3, 3)
    weight[range(4), range(4), 1, 1] = 1.0  # s_hat = s
    table = torch.zeros(1, 4, 84, 84)
    _, s, _ = transitions(5)
    following = s.clone()
    following[:, 2, 30, 31] ^= 1
    zero = torch.zeros(5, dtype=torch.int64)
    error = factored_error(table, weight, zero, s, following)
    torch.testing.assert_close(error, torch.full((5,), 1 / 127.5**2), rtol=1e-3, atol=0)
    assert factored_error(table, weight, zero, s, s).max() < 1e-5


@pytest.mark.parametrize("batch", [(), (2, 3), (0,)])
def test_any_leading_shape(decoder, batch):
    data = transitions(*batch)
    error = factored_error(*parts(decoder), *data)
    assert error.shape == batch
    torch.testing.assert_close(error, literal_error(decoder, *data, True), rtol=1e-5, atol=0)


def test_inputs_that_are_not_contiguous_and_left_as_they_were(decoder):
    action, observation, following = transitions(3, 2)
    data = [x.transpose(0, 1) for x in (action, observation, following)]
    table, weight = (x.detach() for x in parts(decoder))
    copies = [x.clone() for x in (table, weight, *data)]
    error = factored_error(table, weight, *data)
    torch.testing.assert_close(error, literal_error(decoder, *data, True), rtol=1e-5, atol=0)
    assert all(torch.equal(a, b) for a, b in zip((table, weight, *data), copies, strict=True))


def test_another_number_of_channels():
    decoder = PixelDecoder(ACTIONS, channels=1)
    data = transitions(3, channels=1)
    error = factored_error(*parts(decoder), *data)
    torch.testing.assert_close(error, literal_error(decoder, *data, True), rtol=1e-5, atol=0)


def test_white_next_to_nothing_is_a_mid_grey_border():
    """What lies beyond the frame counts as 0 on the scale of [-1, 1], not as black."""
    weight = torch.ones(1, 1, 3, 3) / 16
    white = torch.full((1, 1, 84, 84), 255, dtype=torch.uint8)
    seen = F.conv2d(torch.ones(1, 1, 84, 84), weight, padding=2, dilation=2)
    assert seen[0, 0, 0, 0] == 4 / 16
    error = factored_error(torch.zeros(1, 1, 84, 84), weight, torch.tensor([0]), white, white)
    assert error.item() == pytest.approx((seen - 1).square().sum().item(), rel=1e-5)
