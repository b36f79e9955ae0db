"""What TorchRL's own suite asks of every transform, asked of ours.

The names are those of TorchRL's list: in an environment alone, inside and outside of batched ones,
without an environment, in a Compose, before a model, in a replay buffer, inverted.
"""

from functools import partial

import pytest
import torch
from tensordict import LazyStackedTensorDict, TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import (
    LazyMemmapStorage,
    LazyStackStorage,
    LazyTensorStorage,
    ReplayBuffer,
    TensorDictReplayBuffer,
)
from torchrl.envs import Compose, GymEnv, ParallelEnv, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from giril_rl.errors import UserError
from giril_rl.transforms import BatchMeanReward, IntrinsicReward, ReturnScaling, WeightedReward


def change(observation, following):
    return (following - observation).square().sum(-1, keepdim=True) + 1.0


def _key(group, name):
    return name if group is None else (group, name)


def intrinsic(group=None):
    keys = [_key(group, "observation"), ("next", _key(group, "observation"))]
    module = TensorDictModule(change, keys, [("next", _key(group, "mine"))])
    more = {"reward_key": _key(group, "reward"), "extrinsic_key": _key(group, "true")}
    return IntrinsicReward(module, **more)


def scaling(group=None):
    return ReturnScaling(reward_key=_key(group, "reward"))


def mean(group=None):
    return BatchMeanReward(_key(group, "reward"))


def weighted(group=None):
    key = _key(group, "reward")
    return WeightedReward({key: 0.5}, reward_key=key)


MAKERS = [intrinsic, scaling, mean, weighted]
KNOW_ONE_ENVIRONMENT = [intrinsic, weighted]
pendulum = partial(GymEnv, "Pendulum-v1")
ForkedEnv = partial(ParallelEnv, mp_start_method="fork")  # Many times as fast to start.
pytestmark = pytest.mark.filterwarnings("ignore:A lambda function was passed")


def transitions(*shape, group=None, seed=0):
    generator = torch.Generator().manual_seed(seed)
    first, then, reward = (torch.randn(*shape, n, generator=generator) for n in (3, 3, 1))
    names = {"observation": then, "reward": reward}
    return TensorDict(
        {
            _key(group, "observation"): first,
            "next": {_key(group, key): value for key, value in names.items()},
            "other": reward.clone(),
        },
        shape,
    )


def reward_of(batch, group=None):
    return batch["next"].get(_key(group, "reward"))


@pytest.fixture(params=MAKERS)
def make(request):
    return request.param


def test_single_trans_env_check(make, counter_env):
    check_env_specs(TransformedEnv(pendulum(), make()))
    check_env_specs(TransformedEnv(counter_env(group="agent"), make("agent")))


@pytest.mark.parametrize("batched", [SerialEnv, ForkedEnv])
def test_serial_and_parallel_trans_env_check(make, batched):
    def inside():
        return batched(2, lambda: TransformedEnv(pendulum(), make()))

    if make not in KNOW_ONE_ENVIRONMENT:
        with pytest.raises(UserError, match="outside"):
            inside().reset()
        return
    env = inside()
    try:
        check_env_specs(env)
        assert env.rollout(3)["next", "reward"].shape == (2, 3, 1)
    finally:
        env.close(raise_if_closed=False)


@pytest.mark.parametrize("batched", [SerialEnv, ForkedEnv])
def test_trans_serial_and_parallel_env_check(make, batched):
    env = TransformedEnv(batched(2, pendulum), make())
    try:
        check_env_specs(env)
        assert env.rollout(3)["next", "reward"].shape == (2, 3, 1)
    finally:
        env.close(raise_if_closed=False)


@pytest.mark.parametrize("group", [None, "agent"])
@pytest.mark.parametrize("shape", [(), (4,), (6, 4), (2, 3, 4)])
def test_transform_no_env(make, shape, group):
    batch = transitions(*shape, group=group)
    given = batch.clone()
    out = make(group)(batch)
    assert (batch == given).all() and out.shape == shape
    assert reward_of(out, group).shape == (*shape, 1) and reward_of(out, group).isfinite().all()
    kept = given.exclude(("next", *reward_path(group)))
    assert all(torch.equal(out[key], kept[key]) for key in kept.keys(True, True))
    if make in KNOW_ONE_ENVIRONMENT and len(shape) > 1:
        flat = make(group)(given.reshape(-1))
        torch.testing.assert_close(reward_of(flat, group).reshape(*shape, 1), reward_of(out, group))


def reward_path(group):
    return ("reward",) if group is None else (group, "reward")


def test_lazy_stacks(make):
    batch = transitions(4, 6)
    lazy = LazyStackedTensorDict.lazy_stack(batch.clone().unbind(0))
    out = make()(lazy)
    assert torch.equal(out["next", "reward"], make()(batch)["next", "reward"])
    assert (lazy == batch).all()


def test_transform_compose(make):
    batch = transitions(4, 6)
    alone = make()(batch.clone())["next", "reward"]
    assert torch.equal(Compose(make())(batch.clone())["next", "reward"], alone)
    if make is intrinsic:  # Both would keep a true reward in one place.
        with pytest.raises(UserError, match=r"\('next', 'true'\) already"):
            Compose(intrinsic(), make())(batch)
        return
    both = Compose(intrinsic(), make())(batch.clone())
    assert torch.equal(both["next", "reward"], make()(intrinsic()(batch))["next", "reward"])


def test_transform_env(make):
    env = TransformedEnv(pendulum(), make())
    start = env.reset()
    assert "reward" not in start.keys()
    assert ("true" in start.keys()) == (make is intrinsic)
    step = env.step(start.set("action", torch.tensor([1.0])))
    assert env.reward_spec.is_in(step["next", "reward"])
    assert env.reward_key == "reward"
    assert env.observation_spec.is_in(start.select(*env.observation_spec.keys()))
    if make is intrinsic:
        expected = change(step["observation"], step["next", "observation"])
        assert torch.equal(step["next", "reward"], expected)


def test_transform_model(make):
    model = TensorDictModule(nn.Linear(1, 2), [("next", "reward")], ["value"])
    out = nn.Sequential(make(), model)(transitions(5))
    assert torch.equal(out["value"], model.module(out["next", "reward"]))


@pytest.mark.parametrize("rbclass", [ReplayBuffer, TensorDictReplayBuffer])
def test_transform_rb(make, rbclass):
    buffer, transform, batch = rbclass(storage=LazyTensorStorage(20)), make(), transitions(20)
    buffer.append_transform(transform)
    buffer.extend(batch)
    if make is scaling:  # A sample is in no order of time: nothing can be learned from it.
        with pytest.raises(UserError, match="eval mode"):
            buffer.sample(8)
        transform.train()(batch.clone())
        transform.eval()
    sample = buffer.sample(8)
    assert sample["next", "reward"].shape == (8, 1)
    if make is intrinsic:
        expected = change(sample["observation"], sample["next", "observation"])
        assert torch.equal(sample["next", "reward"], expected)
    elif make is scaling:
        factor = sample["next", "reward"] / sample["other"]
        torch.testing.assert_close(factor, factor[:1].expand_as(factor))
    else:
        factor = 0.5 if make is weighted else 1.0
        assert torch.equal(sample["next", "reward"], factor * sample["other"])


@pytest.mark.parametrize("storage", [LazyTensorStorage, LazyMemmapStorage, LazyStackStorage])
def test_a_buffer_keeps_what_it_stores(make, storage):
    buffer = TensorDictReplayBuffer(storage=storage(5), transform=make(), batch_size=5)
    given = transitions(5)
    if make is scaling:
        buffer.transform.train()(given)
        buffer.transform.eval()
    buffer.extend(given)
    once = buffer[:]["next", "reward"].clone()
    buffer.sample()
    assert torch.equal(buffer[:]["next", "reward"], once)
    assert (buffer.storage[:].select(*given.keys(True, True)) == given).all()
    assert "true" not in buffer.storage[:]["next"].keys()


def test_transform_inverse(make):
    batch = transitions(4, 6)
    given = batch.clone()
    assert (make().inv(batch) == given).all()


@pytest.mark.parametrize("device", ["cpu", "meta", "cuda"])
def test_device_moves(make, device):
    if device == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA device here")
    if device == "meta":  # Shows without another device that nothing is left behind.
        state = make().to(device).state_dict().values()
        assert all(value.device.type == "meta" for value in state)
        return
    out = make().to(device)(transitions(4, 6).to(device))
    assert out["next", "reward"].device.type == device
    expected = make()(transitions(4, 6))["next", "reward"]
    torch.testing.assert_close(out["next", "reward"].cpu(), expected)
