"""Each builder takes frames for frames and vectors for vectors."""

import pytest
import torch
from giril_rl.methods.reward_models import (
    bottleneck_reward,
    copy_reward,
    curiosity_reward,
    discriminator_reward,
    generative_reward,
)
from giril_rl.networks.pixel_discriminators import PixelBottleneck, PixelDiscriminator
from tensordict import TensorDict

from giril_rl.config.schema import (
    AdversarialConfig,
    BottleneckConfig,
    CuriosityConfig,
    GenerativeConfig,
    TaskConfig,
)
from giril_rl.envs import make_env
from giril_rl.errors import UserError
from giril_rl.networks.pixel_decoder import PixelDecoder
from giril_rl.networks.pixels import PixelEncoder, PixelFeatures, PixelPrior
from giril_rl.rewards import ObservationScaler, PixelScaler


def build_copy(cfg, env, data, *, seed):
    return copy_reward(cfg, env, data)


BUILDERS = {
    "generative": (generative_reward, GenerativeConfig(prior="conditional")),
    "curiosity": (curiosity_reward, CuriosityConfig()),
    "copy": (build_copy, GenerativeConfig()),
    "discriminator": (discriminator_reward, AdversarialConfig()),
    "bottleneck": (bottleneck_reward, BottleneckConfig(latent=3)),
}
PIXEL_PARTS = {
    "generative": {PixelEncoder, PixelDecoder, PixelPrior, PixelFeatures},
    "curiosity": {PixelFeatures},
    "copy": set(),
    "discriminator": {PixelDiscriminator},
    "bottleneck": {PixelBottleneck},
}
KINDS = {PixelEncoder, PixelDecoder, PixelPrior, PixelFeatures, PixelDiscriminator, PixelBottleneck}

every_builder = pytest.mark.parametrize("name", BUILDERS)


def world(env_id):
    """An environment, what a random policy did there, and the transitions that a scaler sees."""
    if env_id.startswith("ALE/"):
        pytest.importorskip("ale_py")
    env = make_env(TaskConfig(name="test", env_id=env_id), 2, seed=0)
    batch = env.rollout(3, break_when_any_done=False)
    return env, batch, batch.reshape(-1).select("observation")


@pytest.fixture(scope="module")
def breakout():
    return world("ALE/Breakout-v5")


def built(name, env, data, seed=0, **changes):
    build, cfg = BUILDERS[name]
    cfg = type(cfg)(**{**vars(cfg), **changes})
    return build(cfg, env, data, seed=seed)


def paid(reward, batch):
    with torch.no_grad():
        return reward.eval()(batch.clone())["next", "intrinsic_reward"]


def parts(reward):
    return {type(part) for part in reward.modules()} & KINDS


@every_builder
def test_frames(name, breakout):
    env, batch, data = breakout
    reward = built(name, env, data, normalise="pixels")
    assert isinstance(reward.scaler, PixelScaler)
    assert parts(reward) == PIXEL_PARTS[name]
    value = paid(reward, batch)
    assert value.shape == (2, 3, 1) and value.isfinite().all()
    assert torch.equal(value, paid(built(name, env, data, normalise="pixels"), batch))
    if name != "copy":
        assert not torch.equal(value, paid(built(name, env, data, seed=1), batch))


@every_builder
def test_vectors(name):
    env, batch, data = world("CartPole-v1")
    reward = built(name, env, data)
    assert isinstance(reward.scaler, ObservationScaler) and reward.scaler.fitted
    assert parts(reward) == set()
    assert paid(reward, batch).shape == (2, 3, 1)


def test_settings_reach_the_models_of_frames(breakout):
    env, _, data = breakout
    giril = built("generative", env, data, beta=0.6, scale=0.3, clamp=False, prior="standard")
    assert (giril.beta, giril.scale, giril.scaler.clamp) == (0.6, 0.3, False)
    assert giril.prior_network is None
    assert built("curiosity", env, data, scale=0.3).scale == 0.3
    copied = built("copy", env, data, scale=0.3, clamp=False)
    assert (copied.scale, copied.scaler.clamp) == (0.3, False)
    assert built("discriminator", env, data, form="negative").form == "negative"
    vail = built("bottleneck", env, data, form="negative", latent=5)
    assert vail.form == "negative" and vail.head.in_features == 5


@pytest.mark.parametrize("name", ["generative", "curiosity", "copy"])
def test_a_demonstration_of_something_else_is_refused(name, breakout):
    env, _, _ = breakout
    vectors = TensorDict({"observation": torch.zeros(5, 4)}, [5])
    with pytest.raises(UserError, match="uint8"):
        built(name, env, vectors)
