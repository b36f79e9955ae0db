"""Transforms that change observations, before and after the reward that reads them."""

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import (
    CatFrames,
    ClipTransform,
    Compose,
    NextObservationDelta,
    ObservationNorm,
    StepCounter,
    TransformedEnv,
    VecNorm,
    VecNormV2,
)
from torchrl.record import VideoRecorder

from giril_rl.errors import UserError
from giril_rl.transforms import IntrinsicReward, ReturnScaling

READ = {"in_keys": ["observation"]}


def moved(*keys):
    """A reward that pays s' - s of the step counter."""
    keys = keys or ("observation", ("next", "observation"))
    return IntrinsicReward(
        TensorDictModule(
            lambda s, following: following[..., 1:2] - s[..., 1:2], list(keys), ["moved"]
        )
    )


def norm(**more):
    return ObservationNorm(1.0, 3.0, **READ, **more)


AFTER = {
    "norm": norm,
    "running norm": lambda: VecNorm(**READ),
    "running norm 2": lambda: VecNormV2(**READ),
    "clip": lambda: ClipTransform(**READ, low=-1, high=1),
    "frames": lambda: CatFrames(2, -1, **READ),
}
HARMLESS = {
    "another key": lambda: norm(out_keys=["normalised"]),
    "a counter": StepCounter,
    "a recorder": lambda: VideoRecorder(None, "film", **READ),
    "a shorter record": lambda: NextObservationDelta(**READ),
    "inverted": lambda: norm(in_keys_inv=["observation"]),
}


@pytest.mark.parametrize("name", AFTER)
def test_observations_changed_after_the_reward_are_refused(name, counter_env):
    other = AFTER[name]()
    env = TransformedEnv(counter_env(), Compose(moved(), ReturnScaling()))
    env.rollout(2)
    env.append_transform(other)
    with pytest.raises(UserError, match=f"put {type(other).__name__} before the reward"):
        env.reset()


@pytest.mark.parametrize("name", HARMLESS)
def test_what_leaves_its_observations_alone_may_come_after(name, counter_env, recwarn):
    env = TransformedEnv(counter_env(1), Compose(moved(), HARMLESS[name]()))
    assert env.observation_spec is not None and not recwarn
    if name != "a recorder":
        assert env.rollout(2)["next", "reward"].eq(1).all()


def test_before_the_reward_both_are_changed_and_it_says_so(counter_env):
    env = TransformedEnv(counter_env(1), Compose(norm(), moved(), ReturnScaling(clip=None)))
    with pytest.warns(UserWarning, match="after ObservationNorm and sees normalised 'observation'"):
        env.reset()
    env = TransformedEnv(counter_env(1), Compose(norm(), moved()))
    with pytest.warns(UserWarning, match="fit it on transitions of this environment"):
        assert env.rollout(2)["next", "reward"].eq(3).all()
    env = TransformedEnv(counter_env(1), Compose(norm(in_keys_inv=["observation"]), moved()))
    with pytest.raises(UserError, match="put ObservationNorm after the reward"):
        env.reset()


def test_a_normalised_copy_may_be_read_knowingly(counter_env, recwarn):
    keys = ("normalised", ("next", "normalised"))
    env = TransformedEnv(counter_env(1), Compose(norm(out_keys=["normalised"]), moved(*keys)))
    assert torch.equal(env.rollout(2)["next", "reward"], torch.full((1, 2, 1), 3.0))
    assert not recwarn
