import pytest
import torch
import torch.nn.functional as F
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded, Categorical, OneHot
from torchrl.objectives import GAILLoss

from giril_rl.errors import UserError
from giril_rl.graphs import TracedGradients
from giril_rl.rewards import (
    BottleneckLoss,
    BottleneckReward,
    DiscriminatorLoss,
    DiscriminatorReward,
)
from giril_rl.rewards.adversarial import gradient_penalty

SPECS = {"box": Bounded(-1.0, 1.0, shape=(2,)), "discrete": Categorical(4), "one_hot": OneHot(4)}


def pairs(n, kind="box", shift=0.0):
    action = 2 * torch.rand(n, 2) - 1 if kind == "box" else torch.randint(4, (n,))
    if kind == "one_hot":
        action = F.one_hot(action, 4).bool()
    return TensorDict({"observation": torch.randn(n, 3) + shift, "action": action}, [n])


def sets(experts=5, policies=9, kind="box"):
    # Without the sub-dicts' batch sizes, which differ.
    return TensorDict(
        {
            "expert": pairs(experts, kind).to_dict(),
            "policy": pairs(policies, kind, shift=1.0).to_dict(),
        }
    )


def make(kind="box", rule="raw", **kwargs):
    reward = DiscriminatorReward.for_vectors(
        3, SPECS[kind], hidden=[16], normalise=rule, clamp=None, seed=1
    )
    return DiscriminatorLoss(reward, **kwargs)


def total(out):
    return sum(value for name, value in out.items() if name.startswith("loss_"))


def gradients(module, loss):
    module.zero_grad()
    loss.backward()
    return [p.grad.clone() for p in module.parameters()]


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
            "action": batch["expert", "action"],
            "collector_observation": batch["policy", "observation"],
            "collector_action": batch["policy", "action"],
        },
        [len(batch["expert", "action"])],
    )
    return loss, loss(flat)


def test_equal_to_torchrls_where_it_can_be():
    """Its sets have one size, its network gives probabilities under ``d_logits``."""
    loss, batch = make(), sets(64, 64)
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
    loss, batch = make(), sets(64, 64)
    torch.manual_seed(5)
    _, theirs = torchrl_loss(loss.reward, batch, use_grad_penalty=True, gp_lambda=10.0)
    torch.manual_seed(5)
    noise = [torch.rand(64, 3), torch.rand(64, 2)]
    points = [
        u * batch["policy", key] + (1 - u) * batch["expert", key]
        for u, key in zip(noise, ("observation", "action"), strict=True)
    ]
    found = gradient_penalty(lambda s, a: torch.sigmoid(loss.reward.logit(s, a)), points)
    torch.testing.assert_close(10 * found, theirs["gp_loss"], atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("kind", SPECS)
@pytest.mark.parametrize(("experts", "policies"), [(5, 9), (9, 5), (4, 4), (1, 30)])
def test_terms_independently(kind, experts, policies):
    loss, batch = make(kind, penalty=3.0), sets(experts, policies, kind)
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
    before = torch.get_rng_state()
    loss = make()
    out = loss(sets_fixed())
    assert "loss_penalty" not in out.keys()
    assert set(out.keys()) == set(loss.out_keys)
    torch.set_rng_state(before)
    loss(sets_fixed())
    assert torch.equal(torch.get_rng_state(), before)


def sets_fixed():
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return sets()


@pytest.mark.parametrize("kind", SPECS)
def test_every_parameter_gets_a_gradient(kind):
    for penalty in (0.0, 1.0):
        loss = make(kind, penalty=penalty)
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
        loss = make(penalty=penalty)
        optimiser = torch.optim.Adam(loss.parameters(), lr=1e-2)
        for _ in range(200):
            optimiser.zero_grad()
            total(loss(batch)).backward()
            optimiser.step()
        point = batch["expert", "observation"].clone().requires_grad_()
        loss.reward.logit(point, batch["expert", "action"]).sum().backward()
        return point.grad.norm(dim=1).mean().item()

    assert slope(10.0) == pytest.approx(1.0, abs=0.2)
    assert abs(slope(0.0) - 1) > 0.3


def test_it_learns_to_tell_the_sets_apart():
    torch.manual_seed(0)
    loss, batch = make("discrete"), sets(50, 200, "discrete")
    optimiser = torch.optim.Adam(loss.parameters(), lr=1e-2)
    for _ in range(200):
        optimiser.zero_grad()
        total(loss(batch)).backward()
        optimiser.step()
    out = loss(batch)
    assert out["accuracy_expert"] > 0.8 and out["accuracy_policy"] > 0.8
    logit = loss.reward.logit(*loss.reward.inputs(*pairs(500, "discrete").values()))
    assert logit.mean() > 0  # Pairs as the expert's are called the expert's.


@pytest.mark.parametrize("penalty", [0.0, 2.0])
def test_recorded_equals_plain(penalty):
    """Also after the statistics have changed in place."""
    loss, batch = make(rule="running", penalty=penalty), sets()
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
            make(penalty=penalty)


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
