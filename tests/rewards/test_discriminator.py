"""GAIL's and VAIL's reward, and GAIL's loss, against the equations written out."""

import pytest
import torch
import torch.nn.functional as F
from reward_data import SPECS, Fixed, sets, total, train, transition, vectors
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded, Categorical
from torchrl.objectives import GAILLoss

from giril_rl.errors import UserError
from giril_rl.graphs.gradients import TracedGradients
from giril_rl.rewards import (
    ActionEncoder,
    BottleneckLoss,
    BottleneckReward,
    DiscriminatorLoss,
    DiscriminatorReward,
    ObservationScaler,
)
from giril_rl.rewards.adversarial import gradient_penalty

KINDS = [DiscriminatorReward, BottleneckReward]


def make(cls=DiscriminatorReward, kind="box", **kwargs):
    return cls.for_vectors(3, SPECS[kind], **{"normalise": "raw", "hidden": [16], **kwargs})


def loss_of(kind="box", rule="raw", **kwargs):
    return DiscriminatorLoss(make(kind=kind, normalise=rule, clamp=None, seed=1), **kwargs)


def reward_of(module, batch):
    return module(batch.clone())["next", "intrinsic_reward"]


def gradients(module, loss):
    module.zero_grad()
    loss.backward()
    return [p.grad.clone() for p in module.parameters()]


# The reward


def test_the_logit_by_hand():
    # logit = s1 + 2 s2 + 3 a, s clamped to 4; action 6 is executed as 4, which is encoded as 1
    reward = DiscriminatorReward(
        Fixed(lambda x: x @ torch.tensor([[1.0], [2.0], [3.0]])),
        scaler=ObservationScaler(2, rule="raw", clamp=True, limit=4.0),
        actions=ActionEncoder(Bounded(0.0, 4.0, shape=(1,))),
        form="log_ratio",
    )
    s = torch.tensor([[1.0, 2.0], [9.0, -9.0]])
    batch = transition(s, torch.tensor([[6.0], [0.0]]), s)
    # 1 + 4 + 3, and 4 - 8 - 3
    assert reward_of(reward, batch).tolist() == [[8.0], [-7.0]]
    reward.form = "positive"
    assert reward_of(reward, batch).flatten().exp().tolist() == pytest.approx(
        [1 + torch.tensor(8.0).exp().item(), 1 + torch.tensor(-7.0).exp().item()], rel=1e-5
    )


def test_the_bottlenecks_reward_is_that_of_the_mean():
    # mean of z: (s1, a); log-variance large: it plays no role
    reward = BottleneckReward(
        Fixed(lambda x: torch.cat((x[..., :1], x[..., 3:], torch.full_like(x[..., :2], 9.0)), -1)),
        Fixed(lambda z: z @ torch.tensor([[2.0], [10.0]])),
        scaler=ObservationScaler(3, rule="raw", clamp=False),
        actions=ActionEncoder(Bounded(-1.0, 1.0, shape=(1,))),
        form="log_ratio",
    )
    s = torch.tensor([[0.5, 7.0, 7.0]])
    for _ in range(2):
        assert reward_of(reward, transition(s, torch.tensor([[-0.25]]), s)).tolist() == [[-1.5]]


def test_who_decides_the_scale():
    demo, policy = torch.randn(500, 3), 7 * torch.randn(500, 3) + 3
    running, fixed = make(normalise="running"), make(normalise="standardise")
    for reward in (running, fixed):
        reward.fit_scaler(demo)
        reward.observe(policy)
    observation, action = policy[:50], torch.zeros(50, 2)
    expected = ((observation - policy.mean(0)) / policy.std(0)).clamp(-10, 10)
    found = running.inputs(observation, action)[0]
    torch.testing.assert_close(found, expected, atol=1e-2, rtol=1e-2)
    expected = ((observation - demo.mean(0)) / demo.std(0, correction=0)).clamp(-10, 10)
    torch.testing.assert_close(fixed.inputs(observation, action)[0], expected)
    assert expected.abs().max() == 10


def test_the_clamp_may_be_left_out():
    far = torch.full((1, 3), 1e3)
    for rule in ("running", "raw"):
        assert make(normalise=rule, clamp=None).inputs(far, torch.zeros(1, 2))[0].max() == 1e3
        assert make(normalise=rule, clamp=2.0).inputs(far, torch.zeros(1, 2))[0].max() == 2


def test_shapes_of_the_papers_networks():
    def widths(network):
        return [m.out_features for m in network if isinstance(m, nn.Linear)]

    gail = DiscriminatorReward.for_vectors(3, Categorical(4))
    assert widths(gail.network) == [100, 100, 1]
    assert gail.network[0].in_features == 7
    vail = BottleneckReward.for_vectors(3, Categorical(4), latent=5)
    assert widths(vail.network) == [100, 100, 10]
    assert (vail.head.in_features, vail.head.out_features) == (5, 1)


@pytest.mark.parametrize("cls", KINDS)
def test_dispatch(cls):
    reward, batch = make(cls), vectors(6)
    called = reward(observation=batch["observation"], action=batch["action"])
    assert torch.equal(called, reward_of(reward, batch))


def test_bad_arguments():
    with pytest.raises(UserError, match="form='airl'"):
        make(form="airl")
    with pytest.raises(UserError, match="normalise='minmax'"):
        make(normalise="minmax")
    with pytest.raises(UserError, match="two in_keys"):
        make(in_keys=["observation"])
    with pytest.raises(UserError, match="has not seen a demonstration"):
        make(normalise="standardise")(vectors(2))


# The loss


class Probability(nn.Module):
    """What TorchRL's loss wants: the probability, from raw observations and actions."""

    def __init__(self, reward):
        super().__init__()
        self.reward = reward

    def forward(self, observation, action):
        return torch.sigmoid(self.reward.logit(observation, action)).unsqueeze(-1)


def torchrl_loss(reward, batch, **kwargs):
    network = TensorDictModule(
        Probability(reward), in_keys=["observation", "action"], out_keys=["d_logits"]
    )
    loss = GAILLoss(network, **kwargs)
    flat = TensorDict(
        {
            "observation": batch["expert", "observation"],
            "action": reward.actions(batch["expert", "action"]),
            "collector_observation": batch["policy", "observation"],
            "collector_action": reward.actions(batch["policy", "action"]),
        },
        [len(batch["expert", "action"])],
    )
    return loss, loss(flat)


def test_equal_to_torchrls_where_it_can_be():
    """Its sets have one size, its network gives probabilities under ``d_logits``."""
    loss, batch = loss_of(), sets(64, 64)
    module, theirs = torchrl_loss(loss.reward, batch)
    ours = total(loss(batch))
    torch.testing.assert_close(ours, theirs["loss"], atol=1e-6, rtol=1e-6)
    theirs["loss"].backward()
    expected = [p.grad for p in module.parameters()]
    found = gradients(loss, ours)
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, atol=1e-6, rtol=1e-5)


def test_penalty_equal_to_torchrls_at_its_points():
    """It penalises the slope of the probability, with a weight for each number."""
    loss, batch = loss_of(), sets(64, 64)
    torch.manual_seed(5)
    _, theirs = torchrl_loss(loss.reward, batch, use_grad_penalty=True, gp_lambda=10.0)
    torch.manual_seed(5)
    noise = [torch.rand(64, 3), torch.rand(64, 2)]
    inputs = {
        name: loss.reward.inputs(batch[name, "observation"], batch[name, "action"])
        for name in ("expert", "policy")
    }
    points = [
        u * policy + (1 - u) * expert
        for u, policy, expert in zip(noise, inputs["policy"], inputs["expert"], strict=True)
    ]
    found = gradient_penalty(lambda s, a: torch.sigmoid(loss.reward.logit(s, a)), points)
    torch.testing.assert_close(10 * found, theirs["gp_loss"], atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("kind", SPECS)
@pytest.mark.parametrize(("experts", "policies"), [(5, 9), (9, 5), (4, 4), (1, 30)])
def test_terms_independently(kind, experts, policies):
    loss, batch = loss_of(kind, penalty=3.0), sets(experts, policies, kind)
    torch.manual_seed(7)
    out = loss(batch)
    reward = loss.reward

    def logit(which):
        code = reward.actions(batch[which, "action"])
        return reward.network(torch.cat((batch[which, "observation"], code), 1)).squeeze(1)

    for which, label, size in (("expert", 1.0, experts), ("policy", 0.0, policies)):
        z = logit(which)
        expected = F.binary_cross_entropy_with_logits(z, torch.full((size,), label))
        torch.testing.assert_close(out[f"loss_{which}"], expected)
        right = ((z > 0).float() == label).float().mean()
        assert out[f"accuracy_{which}"] == right

    torch.manual_seed(7)
    u = torch.rand(max(experts, policies))
    norms = []
    for i, weight in enumerate(u):
        x = []
        for which, size in (("expert", experts), ("policy", policies)):
            s = batch[which, "observation"][i % size]
            a = reward.actions(batch[which, "action"][i % size])
            x.append(torch.cat((s, a)))
        between = (weight * x[0] + (1 - weight) * x[1]).requires_grad_()
        (slope,) = torch.autograd.grad(reward.network(between).sum(), between)
        norms.append(slope.norm())
    expected = 3.0 * (torch.stack(norms) - 1).square().mean()
    torch.testing.assert_close(out["loss_penalty"], expected)


def test_without_penalty_there_is_no_term_and_no_noise():
    loss, batch = loss_of(), sets()
    before = torch.get_rng_state()
    out = loss(batch)
    assert "loss_penalty" not in out.keys()
    assert set(out.keys()) == set(loss.out_keys)
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("kind", SPECS)
def test_every_parameter_gets_a_gradient(kind):
    for penalty in (0.0, 1.0):
        loss = loss_of(kind, penalty=penalty)
        assert all((g != 0).any() for g in gradients(loss, total(loss(sets(kind=kind)))))
    # The penalty alone reaches the weights, though not the last bias.
    found = gradients(
        loss, loss(sets(kind=kind))["loss_penalty"] + 0 * total(loss(sets(kind=kind)))
    )
    assert all((g != 0).any() for g in found[:-1])


def test_the_penalty_holds_the_slope_at_one():
    torch.manual_seed(0)
    batch = sets(64, 64)
    batch["expert", "observation"] += 4

    def slope(penalty):
        loss = loss_of(penalty=penalty)
        train(loss, batch, steps=200, lr=1e-2)
        point = batch["expert", "observation"].clone().requires_grad_()
        encoding = loss.reward.actions(batch["expert", "action"])
        loss.reward.logit(point, encoding).sum().backward()
        return point.grad.norm(dim=1).mean().item()

    assert slope(10.0) == pytest.approx(1.0, abs=0.2)
    assert abs(slope(0.0) - 1) > 0.3


def test_it_learns_to_tell_the_sets_apart():
    torch.manual_seed(0)
    loss, batch = loss_of("discrete"), sets(50, 200, "discrete")
    train(loss, batch, steps=200, lr=1e-2)
    out = loss(batch)
    assert out["accuracy_expert"] > 0.8 and out["accuracy_policy"] > 0.8
    fresh = vectors(500, kind="discrete")
    logit = loss.reward.logit(*loss.reward.inputs(fresh["observation"], fresh["action"]))
    assert logit.mean() > 0  # Pairs like the expert's are classified as the expert's.


@pytest.mark.parametrize("penalty", [0.0, 2.0])
def test_recorded_equals_plain(penalty):
    """Also after the statistics have changed in place."""
    loss, batch = loss_of(rule="running", penalty=penalty), sets()
    recorded = TracedGradients(loss, keys=loss.in_keys, log=loss.log_keys)
    for _ in range(3):
        loss.reward.observe(3 * torch.randn(100, 3) + 1)
        torch.manual_seed(3)
        out = recorded(batch)
        found = [p.grad.clone() for p in recorded.parameters]
        torch.manual_seed(3)
        plain = loss(batch)
        for name, value in plain.items():
            assert torch.equal(out[name], value), name
        for one, other in zip(found, gradients(loss, total(plain)), strict=True):
            torch.testing.assert_close(one, other, atol=1e-7, rtol=1e-6)


def test_keys_follow_the_reward_and_set_keys():
    reward = DiscriminatorReward.for_vectors(
        3, SPECS["box"], normalise="raw", in_keys=[("agent", "observation"), ("agent", "action")]
    )
    loss = DiscriminatorLoss(reward)
    assert loss.in_keys[:2] == [("expert", "agent", "observation"), ("expert", "agent", "action")]
    batch = sets()
    moved = TensorDict({which: {"agent": batch[which].to_dict()} for which in ("expert", "policy")})
    expected = loss(moved)
    loss.set_keys(
        expert_observation=("expert", "observation"),
        expert_action=("expert", "action"),
        policy_observation="o",
        policy_action=("p", "a"),
    )
    flat = TensorDict(
        {
            "expert": batch["expert"],
            "o": batch["policy", "observation"],
            "p": {"a": batch["policy", "action"]},
        }
    )
    assert (loss(flat) == expected).all()
    called = loss(
        expert_observation=batch["expert", "observation"],
        expert_action=batch["expert", "action"],
        o=batch["policy", "observation"],
        p_a=batch["policy", "action"],
    )
    assert torch.equal(torch.stack(called), torch.stack([expected[k] for k in loss.out_keys]))


def test_bad_penalty():
    for penalty in (-1.0, float("nan")):
        with pytest.raises(UserError, match="penalty"):
            loss_of(penalty=penalty)


@pytest.mark.parametrize(
    ("made", "loss_of"),
    [(DiscriminatorReward, DiscriminatorLoss), (BottleneckReward, BottleneckLoss)],
)
def test_penalty_of_pixels_is_of_single_samples(made, loss_of):
    reward, plain = (made.for_pixels(SPECS["discrete"], seed=1) for _ in range(2))
    sets = TensorDict(
        {
            name: {
                "observation": torch.randint(256, (size, 4, 84, 84), dtype=torch.uint8),
                "action": torch.randint(4, (size,)),
            }
            for name, size in (("expert", 2), ("policy", 3))
        }
    )
    torch.manual_seed(3)
    out = loss_of(reward, penalty=2.0)(sets)
    # The sets' own pass moves the running statistics, the penalty's does not.
    loss_of(plain)(sets)
    for (name, found), expected in zip(reward.named_buffers(), plain.buffers(), strict=True):
        assert torch.equal(found, expected), name
    assert all(part.training for part in reward.modules())

    reward.eval()
    (s, a), (t, b) = (reward.inputs(*sets[name].values()) for name in ("expert", "policy"))
    torch.manual_seed(3)
    if made is BottleneckReward:
        torch.randn(5, reward.encode(s, a)[0].shape[-1])  # z is drawn first.
    weight = torch.rand(3)
    norms = []
    for i in range(3):
        point = [weight[i] * x[i % 2] + (1 - weight[i]) * y[i] for x, y in ((s, t), (a, b))]
        point = [x.unsqueeze(0).requires_grad_() for x in point]
        slopes = torch.autograd.grad(reward.logit(*point).sum(), point)
        norms.append(torch.cat([slope.flatten() for slope in slopes]).norm().item())
    expected = 2.0 * sum((norm - 1) ** 2 for norm in norms) / 3
    assert out["loss_penalty"].item() == pytest.approx(expected, rel=1e-4)
    total(out).backward()
    assert all(p.grad.isfinite().all() for p in reward.parameters())
