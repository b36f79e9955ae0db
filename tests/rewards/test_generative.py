"""GIRIL's reward and loss of vectors against equations 2 and 1 written out."""

import copy
import pickle

import pytest
import torch
from reward_data import NESTED, SPECS, Fixed, nested, train, transition, vectors
from torch import nn
from torch.distributions import Categorical as CategoricalDistribution
from torch.distributions import Independent, Normal, kl_divergence
from torchrl.data import Bounded

from giril_rl.errors import UserError
from giril_rl.rewards import (
    ActionEncoder,
    GenerativeReward,
    GenerativeRewardLoss,
    ObservationScaler,
    action_term,
    blend_action,
    gaussian_kl,
    reconstruction_error,
)


def make(kind="box", **kwargs):
    kwargs = {"normalise": "raw", "clamp": False, **kwargs}
    return GenerativeReward.for_vectors(3, SPECS[kind], **kwargs)


def loss_of(kind="box", reward_kwargs=None, **kwargs):
    reward = GenerativeReward.for_vectors(3, SPECS[kind], **(reward_kwargs or {}))
    reward.scaler.fit(torch.randn(50, 3) * 2 + 1)
    return GenerativeRewardLoss(reward, **kwargs)


def reward_of(module, batch):
    return module(batch.clone())["next", "intrinsic_reward"]


def gaussian(mu, logvar):
    return Independent(Normal(mu, (0.5 * logvar).exp()), 1)


# The pure functions


def test_error_and_blend_by_hand():
    error = reconstruction_error(torch.tensor([[1.0, -1.0], [0.0, 0.0]]), torch.tensor([3.0, 0.0]))
    assert error.tolist() == [5.0, 9.0]
    blended = blend_action(torch.tensor([1.0, 0.0]), torch.tensor([0.2, 0.8]), 0.25)
    assert blended.tolist() == pytest.approx([0.4, 0.6])


def test_gaussian_kl_against_torch():
    mu_q, lv_q, mu_p, lv_p = torch.randn(4, 5, 3)
    expected = kl_divergence(gaussian(mu_q, lv_q), gaussian(mu_p, lv_p))
    torch.testing.assert_close(gaussian_kl(mu_q, lv_q, mu_p, lv_p), expected)
    standard = gaussian(torch.zeros(5, 3), torch.zeros(5, 3))
    expected = kl_divergence(gaussian(mu_q, lv_q), standard)
    torch.testing.assert_close(gaussian_kl(mu_q, lv_q), expected)


def test_action_term_by_hand_and_against_torch():
    z = torch.tensor([[1.0, 2.0], [0.0, 0.0]])
    assert action_term(z, torch.tensor([[0.0, 4.0], [0.0, 0.0]])).tolist() == [2.5, 0.0]
    logits, action = torch.randn(2, 3, 6), torch.randint(6, (2, 3))
    expected = -CategoricalDistribution(logits=logits).log_prob(action)
    torch.testing.assert_close(action_term(logits, action), expected)


# Equation 2


def test_equation_2_by_hand():
    # decoder: s_hat = s + a; action 6 is executed as 4, the bound, which is encoded as 1
    reward = GenerativeReward(
        Fixed(lambda x: x),
        Fixed(lambda x: x[..., 1:] + x[..., :1]),
        scaler=ObservationScaler(2, rule="raw", clamp=False),
        actions=ActionEncoder(Bounded(0.0, 4.0, shape=(1,))),
        scale=0.5,
    )
    s, s_next = torch.tensor([[[1.0, 2.0], [0.0, 0.0]], [[5.0, 1.0], [0.5, -0.5]]])
    batch = transition(s, torch.tensor([[6.0], [3.0]]), s_next)
    # (2, 3) - (5, 1) = (-3, 2): 13 / 2;  (0.5, 0.5) - (0.5, -0.5) = (0, 1): 1 / 2
    assert reward_of(reward, batch).tolist() == [[6.5], [0.5]]


@pytest.mark.parametrize(("beta", "clamp"), [(1.0, True), (0.5, False)])
def test_the_prediction_is_what_the_reward_compares(beta, clamp):
    reward, data = make(beta=beta, normalise="standardise", clamp=clamp), vectors(6)
    reward.scaler.fit(3 * data["observation"] + 1)
    parts = data["observation"], data["action"], data["next", "observation"]
    state = reward.get_extra_state()
    predicted = reward.predict(*parts)
    reward.set_extra_state(state)
    error = reconstruction_error(predicted, reward.scaler(parts[2]))
    assert torch.equal(reward_of(reward, data).squeeze(-1), error)


def test_the_prediction_is_clamped_with_the_states():
    reward = GenerativeReward(
        Fixed(lambda x: x),
        Fixed(lambda x: x[..., 1:] * 100),
        scaler=ObservationScaler(1, rule="raw", clamp=True),
        actions=ActionEncoder(Bounded(-1.0, 1.0, shape=(1,))),
    )
    batch = transition(torch.tensor([[0.7]]), torch.zeros(1, 1), torch.tensor([[-50.0]]))
    assert reward_of(reward, batch).tolist() == [[4.0]]


@pytest.mark.parametrize("kind", ["box", "discrete"])
def test_blend_uses_the_sampled_latent(kind):
    # A posterior of (almost) no variance makes z its mean.
    z = torch.tensor([0.25, -2.0]) if kind == "box" else torch.tensor([2.0, 0.0, -1.0, 0.5])
    k = len(z)
    seen = []
    reward = GenerativeReward(
        Fixed(lambda x: torch.cat((z, torch.full((k,), -80.0))).expand(*x.shape[:-1], -1)),
        Fixed(lambda x: seen.append(x[..., :k]) or x[..., k:]),
        scaler=ObservationScaler(3, rule="raw", clamp=False),
        actions=ActionEncoder(SPECS[kind]),
        beta=0.75,
    )
    batch = vectors(2, kind=kind)
    reward(batch)
    encoded = z if kind == "box" else torch.softmax(z, -1)
    expected = 0.75 * reward.actions(batch["action"]) + 0.25 * encoded
    torch.testing.assert_close(seen[0], expected)


def test_beta_1_ignores_the_encoder():
    reward, batch = make(), vectors(8)
    first = reward_of(reward, batch)
    with torch.no_grad():
        for parameter in reward.encoder.parameters():
            parameter.fill_(torch.nan)
    assert torch.equal(reward_of(reward, batch), first)


def test_noise_is_private_and_restored():
    batch, before = vectors(8), torch.get_rng_state()
    one, two = make(beta=0.5, seed=3), make(beta=0.5, seed=3)
    first = reward_of(one, batch)
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.equal(reward_of(two, batch), first)
    state = copy.deepcopy(one.state_dict())
    assert all(isinstance(v, torch.Tensor) for v in state.values())
    second = reward_of(one, batch)
    assert not torch.equal(second, first)
    fresh = make(beta=0.5, seed=99)
    fresh.load_state_dict(state)
    assert torch.equal(reward_of(fresh, batch), second)


def test_copies_and_pickles():
    reward, batch = make(beta=0.5), vectors(4)
    twin, thawed = copy.deepcopy(reward), pickle.loads(pickle.dumps(reward))
    expected = reward_of(reward, batch)
    for other in (twin, thawed):
        assert torch.equal(reward_of(other, batch), expected)


def test_shapes_of_the_papers_networks():
    reward = make("discrete", prior="conditional")
    assert [m.out_features for m in reward.encoder if isinstance(m, nn.Linear)] == [100, 100, 8]
    mu, logvar = reward.encode(torch.zeros(5, 3), torch.zeros(5, 3))
    assert mu.shape == logvar.shape == (5, 4)
    assert reward.decode(torch.zeros(5, 4), torch.zeros(5, 3)).shape == (5, 3)
    assert reward.prior(torch.zeros(5, 3))[1].shape == (5, 4)
    assert make().prior(torch.zeros(5, 3)) == (None, None)


# Equation 1


@pytest.mark.parametrize("kind", SPECS)
@pytest.mark.parametrize("prior", ["standard", "conditional"])
def test_equation_1_independently(kind, prior):
    loss = loss_of(kind, {"prior": prior, "scale": 0.7}, alpha=3.0, reduction="none")
    batch, reward = vectors(4, 5, kind=kind), loss.reward
    torch.manual_seed(0)
    out = loss(batch)
    assert out.batch_size == (4, 5)

    torch.manual_seed(0)
    demo = reward.scaler
    s = ((batch["observation"] - demo.offset) * demo.scale).clamp(-1, 1)
    s_next = ((batch["next", "observation"] - demo.offset) * demo.scale).clamp(-1, 1)
    mu, logvar = reward.encoder(torch.cat((s, s_next), -1)).split(reward.actions.size, -1)
    q = gaussian(mu, logvar)
    z = mu + torch.exp(logvar / 2) * torch.randn(mu.shape)
    s_hat = reward.decoder(torch.cat((z, s), -1))
    # log N(s'; s_hat, sigma) with 1 / (2 sigma^2) = lambda, less its constant
    sigma = (1 / (2 * 0.7)) ** 0.5
    likelihood = Independent(Normal(s_hat, sigma), 1)
    recon = likelihood.log_prob(s_hat) - likelihood.log_prob(s_next)
    if prior == "standard":
        p = gaussian(torch.zeros_like(mu), torch.zeros_like(mu))
    else:
        p = gaussian(*reward.prior_network(s).split(reward.actions.size, -1))
    if kind == "box":
        action = (z - batch["action"].clamp(-2, 2) / 2).pow(2).mean(-1)
    else:
        index = batch["action"] if kind == "discrete" else batch["action"].int().argmax(-1)
        action = -CategoricalDistribution(logits=z).log_prob(index)
    torch.testing.assert_close(out["loss_reconstruction"], recon, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(out["loss_kl"], kl_divergence(q, p), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(out["loss_action"], 3 * action, rtol=1e-4, atol=1e-5)


def test_default_alpha():
    assert loss_of("box").alpha == 1 and loss_of("discrete").alpha == 100
    assert loss_of("discrete", alpha=2.0).alpha == 2


@pytest.mark.parametrize("kind", SPECS)
@pytest.mark.parametrize("prior", ["standard", "conditional"])
def test_every_parameter_gets_a_gradient(kind, prior):
    loss = loss_of(kind, {"prior": prior})
    sum(loss(vectors(16, kind=kind)).values()).backward()
    for name, parameter in loss.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name


def test_prediction_beyond_the_clamp_keeps_its_gradient():
    loss = loss_of()
    with torch.no_grad():
        loss.reward.decoder[-1].bias.fill_(50.0)
    loss(vectors(4))["loss_reconstruction"].backward()
    assert loss.reward.decoder[-1].bias.grad.abs().min() > 0


def test_it_learns_a_linear_world():
    torch.manual_seed(0)
    reward = GenerativeReward.for_vectors(2, Bounded(-1, 1, shape=(1,)), normalise="demo_range")
    s, a = torch.rand(512, 2) * 2 - 1, torch.rand(512, 1) * 2 - 1
    batch = transition(s, a, 0.5 * s + 0.5 * a)
    reward.scaler.fit(s)
    untrained = reward_of(reward, batch).mean().item()
    train(GenerativeRewardLoss(reward, alpha=10.0), batch, steps=300, lr=3e-3, size=64)
    with torch.no_grad():
        seen = reward_of(reward, batch).mean().item()
        batch["action"] = -batch["action"]
        unseen = reward_of(reward, batch).mean().item()
    assert seen < 0.5 * untrained
    assert unseen > 2 * seen


def test_nested_keys_set_keys_and_dispatch():
    batch, raw = vectors(6), {"normalise": "raw"}
    loss = loss_of(reward_kwargs=raw)
    of_nested = loss_of(reward_kwargs={**raw, "in_keys": NESTED})
    assert of_nested.in_keys == NESTED

    def value(loss, *args, **kwargs):
        torch.manual_seed(0)
        return loss(*args, **kwargs)

    expected = value(loss, batch)
    assert (value(of_nested, nested(batch)) == expected).all()
    loss.set_keys(observation=NESTED[0], action=NESTED[1], next_observation=NESTED[2])
    assert (value(loss, nested(batch)) == expected).all()
    loss.set_keys(observation="observation", action="action", next_observation=("next", "o"))
    called = value(
        loss,
        observation=batch["observation"],
        action=batch["action"],
        next_o=batch["next", "observation"],
    )
    assert torch.equal(torch.stack(called), torch.stack([expected[k] for k in loss.out_keys]))


def test_padding_mask_is_respected():
    batch = vectors(4)
    batch["shifted_valid"] = torch.tensor([True, True, False, True])
    batch["next", "observation"][2] = torch.nan
    assert all(value.isfinite() for value in loss_of()(batch).values())


@pytest.mark.parametrize("beta", [0.0, -0.1, 1.1, float("nan")])
def test_bad_beta(beta):
    with pytest.raises(UserError, match="beta"):
        make(beta=beta)


def test_bad_arguments():
    for key, value in {"prior": "flat", "normalise": "minmax", "in_keys": ["observation"]}.items():
        with pytest.raises(UserError, match=key):
            make(**{key: value})
    for key, value in {"reduction": "median", "alpha": -1.0}.items():
        with pytest.raises(UserError, match=key):
            loss_of(**{key: value})
