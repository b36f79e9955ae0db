"""Collectors of several processes: placement, and fresh weights for copies in the workers."""

import copy
import sys
from functools import partial

import cloudpickle
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector, MultiAsyncCollector, MultiSyncCollector
from torchrl.data import Bounded, Categorical, LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, GymEnv, SerialEnv, TransformedEnv
from torchrl.weight_update import SharedMemWeightSyncScheme

from giril_rl.errors import UserError
from giril_rl.rewards import GenerativeReward
from giril_rl.transforms import IntrinsicReward, ReturnScaling, RewardWeightSyncScheme

# A worker cannot import this file.
cloudpickle.register_pickle_by_value(sys.modules[__name__])

pendulum = partial(GymEnv, "Pendulum-v1")
QUIET = {"auto_register_policy_transforms": False}
PATH = "env.transform[0].module"


def make_reward(seed):
    spec, more = Bounded(-2, 2, shape=(1,)), {"normalise": "raw", "clamp": False}
    return GenerativeReward.for_vectors(3, spec, hidden=(8,), seed=seed, **more)


def make_env(seed=0):
    return TransformedEnv(pendulum(), Compose(IntrinsicReward(make_reward(seed))))


def make_policy():
    return TensorDictModule(nn.Linear(3, 1), ["observation"], ["action"])


def expected(reward, batch):
    return reward(batch.select(*reward.in_keys))["next", "intrinsic_reward"].detach()


def change(module):
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.add_(0.1)


def assert_same(batch, reward):
    torch.testing.assert_close(
        batch["next", "reward"], expected(reward, batch), rtol=1e-4, atol=1e-4
    )


def test_fresh_weights_reach_the_workers_and_postproc_runs_outside():
    reward, policy, scaling = make_reward(5), make_policy(), ReturnScaling(clip=None)
    collector = MultiSyncCollector(
        [make_env] * 2,
        policy,
        frames_per_batch=20,
        total_frames=80,
        cat_results="stack",
        weight_sync_schemes={
            "policy": SharedMemWeightSyncScheme(),
            PATH: RewardWeightSyncScheme(reward),
        },
        postproc=scaling,
    )
    twin = ReturnScaling(clip=None)
    try:
        for i, batch in enumerate(collector):
            assert batch.shape == (2, 10)
            raw = batch.exclude(("next", "reward")).clone()
            raw["next", "reward"] = expected(reward, raw)
            torch.testing.assert_close(
                batch["next", "reward"], twin(raw)["next", "reward"], rtol=1e-4, atol=1e-4
            )
            torch.testing.assert_close(
                batch["action"], policy.module(batch["observation"]), rtol=1e-4, atol=1e-4
            )
            change(reward)
            collector.update_policy_weights_(reward if i else None, model_id=PATH)
            if i == 1:  # Both models, one after the other.
                change(policy)
                collector.update_policy_weights_()
    finally:
        collector.shutdown()
    assert scaling.running_return.shape == (2,)


def test_async_collector_weights_and_postproc():
    reward = make_reward(5)
    collector = MultiAsyncCollector(
        [make_env],
        make_policy(),
        frames_per_batch=10,
        total_frames=100,
        weight_sync_schemes={
            "policy": SharedMemWeightSyncScheme(),
            PATH: RewardWeightSyncScheme(reward),
        },
        postproc=IntrinsicReward(make_reward(1), extrinsic_key="in_worker"),
    )
    try:
        seen = iter(collector)
        before = next(seen)
        torch.testing.assert_close(
            before["next", "in_worker"], expected(reward, before), rtol=1e-4, atol=1e-4
        )
        assert_same(before, make_reward(1))
        change(reward)
        collector.update_policy_weights_(model_id=PATH)
        next(seen), next(seen)  # Those that were under way.
        after = next(seen)
        torch.testing.assert_close(
            after["next", "in_worker"], expected(reward, after), rtol=1e-4, atol=1e-4
        )
    finally:
        collector.shutdown()


def test_workers_of_an_environment_keep_their_copy():
    """No scheme reaches them: the reward belongs outside, where it is the one in training."""
    reward = make_reward(0)
    inside = SerialEnv(
        2, lambda: TransformedEnv(pendulum(), IntrinsicReward(copy.deepcopy(reward)))
    )
    inside.reset()
    outside = TransformedEnv(SerialEnv(2, pendulum), IntrinsicReward(reward))
    change(reward)
    assert_same(outside.rollout(3), reward)
    assert_same(inside.rollout(3), make_reward(0))


def test_one_process_needs_no_scheme():
    reward = make_reward(0)
    env = TransformedEnv(pendulum(), IntrinsicReward(reward))
    collector = Collector(env, make_policy(), frames_per_batch=10, total_frames=20, **QUIET)
    for batch in collector:
        assert_same(batch, reward)
        change(reward)
    collector.shutdown()


def test_collector_that_fills_a_buffer():
    reward = make_reward(0)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(40), transform=IntrinsicReward(reward), batch_size=16
    )
    collector = Collector(
        pendulum(),
        make_policy(),
        frames_per_batch=20,
        total_frames=40,
        replay_buffer=buffer,
        **QUIET,
    )
    for _ in collector:
        change(reward)
        assert_same(buffer.sample(), reward)
    collector.shutdown()


def test_scheme_refuses_what_has_no_weights_or_other_ones():
    with pytest.raises(UserError, match="give the reward module"):
        RewardWeightSyncScheme("reward")
    scheme = RewardWeightSyncScheme(make_reward(0))
    weights = scheme.strategy.extract_weights(make_reward(1))
    twin = make_reward(0)
    scheme.strategy.apply_weights(twin, weights)
    for one, other in zip(twin.parameters(), make_reward(1).parameters(), strict=True):
        assert torch.equal(one, other)
    del weights["decoder"]
    with pytest.raises(UserError, match="build both in the same way"):
        scheme.strategy.apply_weights(twin, weights)
    assert scheme.__getstate__()["_source"] is None


def test_what_was_computed_from_old_weights_is_computed_anew():
    """A reward of frames keeps a table of its decoder's weights; sent ones must replace it."""
    one, other = (GenerativeReward.for_pixels(Categorical(3), seed=seed) for seed in (0, 1))
    frames = torch.randint(256, (2, 3, 4, 84, 84), dtype=torch.uint8)
    batch = {"observation": frames[0], "action": torch.tensor([0, 1, 2])}
    batch = TensorDict({**batch, "next": {"observation": frames[1]}}, [3])

    def rewards(module):
        with torch.no_grad():
            return module.eval()(batch)["next", "intrinsic_reward"].clone()

    assert not torch.allclose(rewards(one), rewards(other))
    strategy = RewardWeightSyncScheme(other).strategy
    strategy.apply_weights(one, strategy.extract_weights(other))
    assert torch.equal(rewards(one), rewards(other))
