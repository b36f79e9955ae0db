import copy

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded, Categorical, OneHot

from giril_rl.errors import UserError
from giril_rl.rewards import (
    ActionEncoder,
    BottleneckReward,
    DiscriminatorReward,
    ObservationScaler,
)

BOX = Bounded(-1.0, 1.0, shape=(1,))
SPECS = {"box": BOX, "discrete": Categorical(4), "one_hot": OneHot(4)}
KINDS = [DiscriminatorReward, BottleneckReward]


class Fixed(nn.Module):
    """A network that is a plain function."""

    def __init__(self, function):
        super().__init__()
        self.function = function

    def forward(self, *x):
        return self.function(torch.cat(x, -1))


def transitions(*batch, kind="box", dim=3):
    action = 3 * torch.randn(*batch, 1) if kind == "box" else torch.randint(4, batch)
    if kind == "one_hot":
        action = torch.nn.functional.one_hot(action, 4).bool()
    observation, following = torch.randn(*batch, dim), torch.randn(*batch, dim)
    return TensorDict(
        {"observation": observation, "action": action, "next": {"observation": following}}, batch
    )


def make(cls=DiscriminatorReward, kind="box", **kwargs):
    return cls.for_vectors(3, SPECS[kind], **{"normalise": "raw", "hidden": [16], **kwargs})


def reward_of(module, batch):
    return module(batch.clone())["next", "intrinsic_reward"]


def test_the_logit_by_hand():
    # logit = s1 + 2 s2 + 3 code, s clamped to 4; action 6 is executed as 4, whose code is 1
    reward = DiscriminatorReward(
        Fixed(lambda x: x @ torch.tensor([[1.0], [2.0], [3.0]])),
        scaler=ObservationScaler(2, rule="raw", clamp=True, limit=4.0),
        actions=ActionEncoder(Bounded(0.0, 4.0, shape=(1,))),
        form="log_ratio",
    )
    batch = TensorDict(
        {
            "observation": torch.tensor([[1.0, 2.0], [9.0, -9.0]]),
            "action": torch.tensor([[6.0], [0.0]]),
        },
        [2],
    )
    # 1 + 4 + 3, and 4 - 8 - 3
    assert reward_of(reward, batch).tolist() == [[8.0], [-7.0]]
    reward.form = "positive"
    assert reward_of(reward, batch).flatten().exp().tolist() == pytest.approx(
        [1 + torch.tensor(8.0).exp().item(), 1 + torch.tensor(-7.0).exp().item()], rel=1e-5
    )


def test_the_bottlenecks_reward_is_that_of_the_mean():
    # mean of z: (s1, code); log-variance large: it takes no part
    reward = BottleneckReward(
        Fixed(lambda x: torch.cat((x[..., :1], x[..., 3:], torch.full_like(x[..., :2], 9.0)), -1)),
        Fixed(lambda z: z @ torch.tensor([[2.0], [10.0]])),
        scaler=ObservationScaler(3, rule="raw", clamp=False),
        actions=ActionEncoder(BOX),
        form="log_ratio",
    )
    batch = TensorDict(
        {"observation": torch.tensor([[0.5, 7.0, 7.0]]), "action": torch.tensor([[-0.25]])}, [1]
    )
    for _ in range(2):
        assert reward_of(reward, batch).tolist() == [[1.0 - 2.5]]


@pytest.mark.parametrize("cls", KINDS)
@pytest.mark.parametrize("kind", SPECS)
@pytest.mark.parametrize("batch", [(), (5,), (2, 5)])
def test_one_reward_per_transition(cls, kind, batch):
    reward, data = make(cls, kind), transitions(*batch, kind=kind)
    out = reward_of(reward, data)
    assert out.shape == (*batch, 1)
    if len(batch) == 2:
        flat = reward_of(reward, data.reshape(-1))
        torch.testing.assert_close(flat.reshape(2, 5, 1), out)


@pytest.mark.parametrize("cls", KINDS)
def test_it_is_a_reward_of_the_pair(cls):
    reward, batch = make(cls), transitions(6)
    first = reward_of(reward, batch)
    changed = batch.clone()
    changed["next", "observation"] = torch.randn(6, 3)
    assert torch.equal(reward_of(reward, changed), first)
    for key in ("observation", "action"):
        changed = batch.clone()
        changed[key] = 0.5 * torch.rand_like(changed[key])
        assert (reward_of(reward, changed) != first).all()


@pytest.mark.parametrize("cls", KINDS)
def test_no_random_numbers_and_no_learning_while_it_is_read(cls):
    reward, batch = make(cls, normalise="running"), transitions(8)
    reward.observe(batch["observation"])
    state, before = copy.deepcopy(reward.state_dict()), torch.get_rng_state()
    first = reward_of(reward, batch)
    assert torch.equal(reward_of(reward, batch), first)
    assert torch.equal(torch.get_rng_state(), before)
    assert all(torch.equal(state[name], value) for name, value in reward.state_dict().items())


@pytest.mark.parametrize("cls", KINDS)
def test_seed_decides_the_weights_alone(cls):
    torch.manual_seed(1)
    before = torch.get_rng_state()
    one = make(cls, seed=3)
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(2)
    batch = transitions(4)
    assert torch.equal(reward_of(make(cls, seed=3), batch), reward_of(one, batch))
    assert not torch.equal(reward_of(make(cls, seed=4), batch), reward_of(one, batch))


@pytest.mark.parametrize("cls", KINDS)
@pytest.mark.parametrize("rule", ["running", "standardise", "demo_range"])
def test_statistics_are_saved(cls, rule):
    one, two = make(cls, normalise=rule, seed=1), make(cls, normalise=rule, seed=2)
    data = 5 * torch.randn(100, 3) + 2
    one.fit_scaler(data)
    one.observe(data)
    batch = transitions(6)
    two.load_state_dict(one.state_dict())
    assert torch.equal(reward_of(one, batch), reward_of(two, batch))


def test_who_decides_the_scale():
    demo, policy = torch.randn(500, 3), 7 * torch.randn(500, 3) + 3
    running, fixed = make(normalise="running"), make(normalise="standardise")
    for reward in (running, fixed):
        reward.fit_scaler(demo)
        reward.observe(policy)
    observation, action = policy[:50], torch.zeros(50, 1)
    expected = ((observation - policy.mean(0)) / policy.std(0)).clamp(-10, 10)
    found = running.inputs(observation, action)[0]
    torch.testing.assert_close(found, expected, atol=1e-2, rtol=1e-2)
    expected = ((observation - demo.mean(0)) / demo.std(0, correction=0)).clamp(-10, 10)
    torch.testing.assert_close(fixed.inputs(observation, action)[0], expected)
    assert expected.abs().max() == 10


def test_the_clamp_may_be_left_out():
    far = torch.full((1, 3), 1e3)
    for rule in ("running", "raw"):
        assert make(normalise=rule, clamp=None).inputs(far, torch.zeros(1, 1))[0].max() == 1e3
        assert make(normalise=rule, clamp=2.0).inputs(far, torch.zeros(1, 1))[0].max() == 2


def test_shapes_of_the_bodies():
    def widths(network):
        return [m.out_features for m in network if isinstance(m, nn.Linear)]

    gail = DiscriminatorReward.for_vectors(3, Categorical(4))
    assert widths(gail.network) == [100, 100, 1]
    assert gail.network[0].in_features == 7
    vail = BottleneckReward.for_vectors(3, Categorical(4), latent=5)
    assert widths(vail.network) == [100, 100, 10]
    assert (vail.head.in_features, vail.head.out_features) == (5, 1)


@pytest.mark.parametrize("cls", KINDS)
def test_nested_keys_and_dispatch(cls):
    keys = [("agent", "observation"), ("agent", "action")]
    plain, nested = make(cls), make(cls, in_keys=keys, out_keys=[("next", "agent", "r")])
    batch = transitions(6)
    inner = {"observation": batch["observation"], "action": batch["action"]}
    found = nested(TensorDict({"agent": inner, "next": {}}, [6]))["next", "agent", "r"]
    assert torch.equal(found, reward_of(plain, batch))
    called = plain(observation=batch["observation"], action=batch["action"])
    assert torch.equal(called, found)


def test_bad_arguments():
    with pytest.raises(UserError, match="form='airl'"):
        make(form="airl")
    with pytest.raises(UserError, match="normalise='minmax'"):
        make(normalise="minmax")
    with pytest.raises(UserError, match="two in_keys"):
        make(in_keys=["observation"])
    with pytest.raises(UserError, match="has not seen a demonstration"):
        make(normalise="standardise")(transitions(2))
