import pytest
import torch

from giril_rl.errors import UserError
from giril_rl.rewards import ObservationScaler, PixelScaler

DEMO = torch.tensor([[0.0, 10.0, 3.0], [4.0, 30.0, 3.0], [1.0, 20.0, 3.0], [3.0, 20.0, 3.0]])


def test_demo_range_by_hand():
    scaler = ObservationScaler(3, rule="demo_range", clamp=False).fit(DEMO)
    out = scaler(torch.tensor([[0.0, 30.0, 3.0], [6.0, 20.0, 3.5]]))
    assert out.tolist() == [[-1.0, 1.0, 0.0], [2.0, 0.0, 0.5]]


def test_standardise_by_hand():
    scaler = ObservationScaler(3, rule="standardise", clamp=False).fit(DEMO)
    # means 2, 20, 3; population deviations sqrt(10 / 4), sqrt(200 / 4), none
    expected = [2.0 / 2.5**0.5, 10.0 / 50.0**0.5, 0.25]
    out = scaler(torch.tensor([4.0, 30.0, 3.25]))
    torch.testing.assert_close(out, torch.tensor(expected))


@pytest.mark.parametrize("rule", ["demo_range", "standardise"])
def test_constant_dimension_is_shifted_only(rule):
    # 0.1 has no exact float, so that its computed deviation is not exactly zero either.
    scaler = ObservationScaler(1, rule=rule, clamp=False).fit(torch.full((1000, 1), 0.1))
    torch.testing.assert_close(scaler(torch.tensor([[0.1], [1.1]])), torch.tensor([[0.0], [1.0]]))
    assert scaler.scale.item() == 1.0


def test_small_scales_are_not_taken_for_constant():
    scaler = ObservationScaler(1, rule="demo_range").fit(torch.tensor([[0.0], [1e-7]]))
    torch.testing.assert_close(scaler(torch.tensor([1e-7])), torch.tensor([1.0]))


def test_clamp():
    clamped = ObservationScaler(3, rule="demo_range", clamp=True).fit(DEMO)
    assert clamped(torch.tensor([100.0, -100.0, 3.0])).tolist() == [1.0, -1.0, 0.0]
    raw = ObservationScaler(2, rule="raw", clamp=True)
    assert raw(torch.tensor([0.3, 7.0])).tolist() == [pytest.approx(0.3), 1.0]
    assert ObservationScaler(1, rule="raw", clamp=False)(torch.tensor([7.0])).item() == 7.0
    wider = ObservationScaler(1, rule="raw", limit=10.0)
    assert wider(torch.tensor([7.0])).item() == 7.0
    assert wider(torch.tensor([-70.0])).item() == -10.0


def test_any_batch_shape_and_dtype():
    scaler = ObservationScaler(3).fit(DEMO.view(2, 2, 3))
    torch.testing.assert_close(scaler.offset, torch.tensor([2.0, 20.0, 3.0]))
    assert scaler(torch.zeros(5, 7, 3, dtype=torch.float64)).shape == (5, 7, 3)
    assert scaler(torch.zeros(3, dtype=torch.float64)).dtype == torch.float32


def test_state_round_trip_into_unfitted():
    fitted, fresh = ObservationScaler(3).fit(DEMO), ObservationScaler(3)
    fresh.load_state_dict(fitted.state_dict())
    torch.testing.assert_close(fresh(DEMO), fitted(DEMO))


def test_unfitted_is_refused():
    with pytest.raises(UserError, match=r"scaler\.fit"):
        ObservationScaler(3)(DEMO)


@pytest.mark.parametrize(
    "demo", [torch.zeros(4, 2), torch.zeros(3), torch.zeros(0, 3), torch.full((2, 3), torch.nan)]
)
def test_bad_demonstration(demo):
    with pytest.raises(UserError):
        ObservationScaler(3).fit(demo)


def test_unknown_rule():
    with pytest.raises(UserError, match="minmax"):
        ObservationScaler(3, rule="minmax")


def test_frames_by_hand():
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


def test_frames_of_any_batch_shape():
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
def test_what_is_no_frame_is_refused(observations):
    for use in (PixelScaler().fit, PixelScaler()):
        with pytest.raises(UserError, match="uint8") as refusal:
            use(observations)
        assert str(tuple(observations.shape)) in str(refusal.value)
