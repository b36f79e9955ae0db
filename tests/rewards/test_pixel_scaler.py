import pytest
import torch

from giril_rl.errors import UserError
from giril_rl.rewards import PixelScaler


def test_by_hand():
    frames = torch.tensor([[[0, 51], [204, 255]]], dtype=torch.uint8)
    expected = torch.tensor([[[-1.0, -0.6], [0.6, 1.0]]])
    for clamp in (True, False):
        out = PixelScaler(clamp=clamp)(frames)
        assert out.dtype == torch.float32
        torch.testing.assert_close(out, expected)


def test_every_byte_has_its_own_value_between_minus_one_and_one():
    out = PixelScaler()(torch.arange(256, dtype=torch.uint8).view(1, 16, 16)).flatten()
    assert (out[0], out[-1]) == (-1, 1)
    torch.testing.assert_close(out.diff(), torch.full((255,), 2 / 255))


def test_any_batch_shape():
    frames = torch.randint(256, (2, 3, 4, 84, 84), dtype=torch.uint8)
    out = PixelScaler()(frames)
    assert out.shape == frames.shape
    assert torch.equal(out[1, 2], PixelScaler()(frames[1, 2]))


def test_there_is_nothing_to_fit_or_to_save():
    scaler = PixelScaler()
    frame = torch.full((1, 2, 2), 7, dtype=torch.uint8)
    before = scaler(frame)
    assert scaler.fit(torch.randint(256, (9, 1, 2, 2), dtype=torch.uint8)) is scaler
    assert torch.equal(scaler(frame), before)
    assert scaler.state_dict() == {}


@pytest.mark.parametrize(
    "observations",
    [torch.zeros(5, 4, 84, 84), torch.zeros(5, 84, dtype=torch.uint8), torch.zeros(5, 3)],
    ids=["floats", "vectors of bytes", "vectors"],
)
def test_other_observations_are_refused(observations):
    for use in (PixelScaler().fit, PixelScaler()):
        with pytest.raises(UserError, match="uint8") as refusal:
            use(observations)
        assert str(tuple(observations.shape)) in str(refusal.value)
