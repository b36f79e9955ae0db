"""VAIL's loss against the equations written out, and its dual variable."""

import pytest
import torch
import torch.nn.functional as F
from reward_data import SPECS, sets, total, train
from torch.distributions import Independent, Normal, kl_divergence

from giril_rl.errors import UserError
from giril_rl.graphs import TracedGradients
from giril_rl.rewards import BottleneckLoss, BottleneckReward


def make(kind="box", **kwargs):
    reward = BottleneckReward.for_vectors(
        3, SPECS[kind], hidden=[16], normalise="raw", clamp=None, seed=1, latent=6
    )
    return BottleneckLoss(reward, **kwargs)


@pytest.mark.parametrize("kind", SPECS)
def test_terms_independently(kind):
    loss, batch = make(kind, information=0.3, beta=2.5), sets(kind=kind)
    reward, terms = loss.reward, {}
    torch.manual_seed(4)
    out = loss(batch)
    torch.manual_seed(4)
    noise = dict(zip(("expert", "policy"), torch.randn(14, 6).split((5, 9)), strict=True))
    for which, label in (("expert", 1.0), ("policy", 0.0)):
        x = torch.cat((batch[which, "observation"], reward.actions(batch[which, "action"])), 1)
        mu, logvar = reward.network(x).split(6, 1)
        q = Independent(Normal(mu, torch.exp(logvar / 2)), 1)
        p = Independent(Normal(torch.zeros(6), torch.ones(6)), 1)
        terms[which] = kl_divergence(q, p).mean()
        z = mu + q.stddev * noise[which]
        logit = z @ reward.head.weight[0] + reward.head.bias
        expected = F.binary_cross_entropy_with_logits(logit, torch.full_like(logit, label))
        torch.testing.assert_close(out[f"loss_{which}"], expected)
    kl = (terms["expert"] + terms["policy"]) / 2  # Each set weighs the same.
    torch.testing.assert_close(out["kl"], kl, atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(out["loss_bottleneck"], 2.5 * (kl - 0.3), atol=1e-6, rtol=1e-5)
    assert set(out.keys()) == set(loss.out_keys)


def test_the_gradient_of_the_bottleneck_is_beta_times_that_of_the_kl():
    batch = sets()

    def slope(beta):
        loss = make(beta=beta)
        (grad,) = torch.autograd.grad(loss(batch)["loss_bottleneck"], loss.reward.network[0].weight)
        return grad

    assert (slope(0.0) == 0).all()
    assert slope(1.0).abs().sum() > 0
    torch.testing.assert_close(slope(3.0), 3 * slope(1.0))


def test_beta_by_hand_and_saved():
    loss = make(information=0.5, beta_step=0.1, beta=0.05)
    seen = []
    for kl in (2.5, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 1.5):
        loss.update_beta(torch.tensor(kl))
        seen.append(loss.beta.item())
    assert seen == pytest.approx([0.25, 0.25, 0.2, 0.15, 0.1, 0.05, 0.0, 0.1], abs=1e-6)
    fresh = make()
    fresh.load_state_dict(loss.state_dict())
    assert fresh.beta.item() == pytest.approx(0.1)
    assert not loss.beta.requires_grad


def trained(information):
    """The constrained KL at the end, beta, and the last terms."""
    torch.manual_seed(0)
    loss, batch, outs = make(information=information, beta_step=0.05), sets(64, 64, shift=2.0), []

    def after(out):
        loss.update_beta(out["kl"])
        outs.append(out)

    train(loss, batch, steps=1500, lr=3e-3, after=after)
    kl = sum(out["kl"].item() for out in outs[-300:]) / 300
    return kl, loss.beta.item(), outs[-1]


def test_the_constraint_holds_and_costs_accuracy():
    kl, beta, out = trained(0.2)
    assert kl == pytest.approx(0.2, abs=0.05)
    assert beta > 0
    free_kl, free_beta, free = trained(1e6)
    assert free_kl > 1 and free_beta == 0
    assert free["loss_expert"] + free["loss_policy"] < out["loss_expert"] + out["loss_policy"]


@pytest.mark.parametrize("penalty", [0.0, 2.0])
def test_recorded_equals_plain(penalty):
    """Also after beta has changed in place."""
    loss, batch = make(penalty=penalty, beta_step=1.0), sets()
    recorded = TracedGradients(loss, keys=loss.in_keys, log=loss.log_keys)
    for _ in range(3):
        torch.manual_seed(3)
        out = recorded(batch)
        found = [p.grad.clone() for p in recorded.parameters]
        torch.manual_seed(3)
        loss.zero_grad()
        plain = loss(batch)
        total(plain).backward()
        for name, value in plain.items():
            assert torch.equal(out[name], value), name
        for one, other in zip(found, loss.parameters(), strict=True):
            torch.testing.assert_close(one, other.grad, atol=1e-7, rtol=1e-6)
        loss.update_beta(torch.tensor(1.5))
    assert loss.beta == 3.0


def test_every_parameter_gets_a_gradient():
    loss = make(beta=1.0)
    total(loss(sets())).backward()
    assert all((p.grad != 0).any() for p in loss.parameters())


@pytest.mark.parametrize("name", ["information", "beta", "beta_step", "penalty"])
def test_bad_arguments(name):
    with pytest.raises(UserError, match=f"{name}=-1.0"):
        make(**{name: -1.0})
