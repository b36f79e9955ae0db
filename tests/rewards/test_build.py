"""Each method's ``build``: frames for frames, vectors for vectors, settings in the model."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Categorical, Unbounded

from giril_rl.errors import UserError
from giril_rl.methods import methods
from giril_rl.networks.pixel_decoder import PixelDecoder
from giril_rl.networks.pixels import (
    PixelBottleneck,
    PixelDiscriminator,
    PixelEncoder,
    PixelFeatures,
)
from giril_rl.rewards import ObservationScaler, PixelScaler

PARTS = {
    "giril": {PixelEncoder, PixelDecoder},
    "cdil": {PixelFeatures},
    "gail": {PixelDiscriminator},
    "vail": {PixelBottleneck},
    "control:copy": set(),
}


def world(frames):
    """An environment's specs, and the observations that a scaler is fitted to."""
    spec = Unbounded((4, 84, 84), dtype=torch.uint8) if frames else Unbounded((3,))
    env = SimpleNamespace(action_spec=Categorical(4), observation_spec={"observation": spec})
    seen = torch.zeros(5, *spec.shape, dtype=spec.dtype)
    return env, TensorDict({"observation": seen}, [5])


def built(name, frames, pairs=None, **changes):
    method, (env, own) = methods()[name], world(frames)
    rule = {"normalise": "pixels"} if frames else {}
    settings = replace(method.settings(), **{**rule, **changes})
    return method.build(settings, env, own if pairs is None else pairs, seed=0)


def parts(reward):
    return {type(part) for part in reward.modules()} & set.union(*PARTS.values())


@pytest.mark.parametrize("name", PARTS)
def test_frames_for_frames_and_vectors_for_vectors(name):
    reward = built(name, True)
    assert isinstance(reward.scaler, PixelScaler) and parts(reward) == PARTS[name]
    reward = built(name, False)
    assert isinstance(reward.scaler, ObservationScaler) and reward.scaler.fitted
    assert parts(reward) == set()


def test_settings_reach_the_models_of_frames():
    giril = built("giril", True, beta=0.6, scale=0.3, clamp=False, prior="conditional")
    assert (giril.beta, giril.scale, giril.scaler.clamp) == (0.6, 0.3, False)
    assert giril.prior_network is not None
    assert built("cdil", True, scale=0.3).scale == 0.3
    copied = built("control:copy", True, scale=0.3, clamp=False)
    assert (copied.scale, copied.scaler.clamp) == (0.3, False)
    assert built("gail", True, form="negative").form == "negative"
    vail = built("vail", True, form="negative", latent=5)
    assert vail.form == "negative" and vail.head.in_features == 5


@pytest.mark.parametrize("name", ["giril", "cdil", "control:copy"])
def test_a_demonstration_of_something_else_is_refused(name):
    with pytest.raises(UserError, match="uint8"):
        built(name, True, world(False)[1])
