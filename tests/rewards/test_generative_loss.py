import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Categorical as CategoricalDistribution
from torch.distributions import Independent, Normal, kl_divergence
from torchrl.data import Bounded, Categorical, OneHot

from giril_rl.errors import UserError
from giril_rl.rewards import GenerativeReward, GenerativeRewardLoss, action_term, gaussian_kl

SPECS = {"box": Bounded(-2.0, 2.0, shape=(2,)), "discrete": Categorical(4), "one_hot": OneHot(4)}


def batch_for(kind, *shape):
    if kind == "box":
        action = 3 * torch.randn(*shape, 2)
    else:
        action = torch.randint(4, shape)
        if kind == "one_hot":
            action = torch.nn.functional.one_hot(action, 4).bool()
    return TensorDict(
        {
            "observation": torch.randn(*shape, 3),
            "action": action,
            "next": {"observation": torch.randn(*shape, 3)},
        },
        shape,
    )


def make(kind="box", reward_kwargs=None, **kwargs):
    reward = GenerativeReward.for_vectors(3, SPECS[kind], **(reward_kwargs or {}))
    reward.scaler.fit(torch.randn(50, 3) * 2 + 1)
    return GenerativeRewardLoss(reward, **kwargs)


def gaussian(mu, logvar):
    return Independent(Normal(mu, (0.5 * logvar).exp()), 1)


def test_gaussian_kl_against_torch():
    mu_q, lv_q, mu_p, lv_p = torch.randn(4, 5, 3)
    p = gaussian(mu_p, lv_p)
    expected = kl_divergence(gaussian(mu_q, lv_q), p)
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


@pytest.mark.parametrize("kind", SPECS)
@pytest.mark.parametrize("prior", ["standard", "conditional"])
def test_equation_1_independently(kind, prior):
    loss = make(kind, {"prior": prior, "scale": 0.7}, alpha=3.0, reduction="none")
    batch, reward = batch_for(kind, 4, 5), loss.reward
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


def test_reductions():
    batch, values = batch_for("box", 8), {}
    for reduction in ("none", "mean", "sum"):
        torch.manual_seed(0)
        values[reduction] = make(reduction=reduction, reward_kwargs={"normalise": "raw"})(batch)
    for key, term in values["none"].items():
        assert term.shape == (8,)
        torch.testing.assert_close(values["mean"][key], term.mean())
        torch.testing.assert_close(values["sum"][key], term.sum())


def test_default_alpha():
    assert make("box").alpha == 1 and make("discrete").alpha == 100
    assert make("discrete", alpha=2.0).alpha == 2


@pytest.mark.parametrize("kind", SPECS)
@pytest.mark.parametrize("prior", ["standard", "conditional"])
def test_every_parameter_gets_a_gradient(kind, prior):
    loss = make(kind, {"prior": prior})
    sum(loss(batch_for(kind, 16)).values()).backward()
    for name, parameter in loss.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name


def test_prediction_beyond_the_clamp_keeps_its_gradient():
    loss = make()
    with torch.no_grad():
        loss.reward.decoder[-1].bias.fill_(50.0)
    loss(batch_for("box", 4))["loss_reconstruction"].backward()
    assert loss.reward.decoder[-1].bias.grad.abs().min() > 0


def test_it_learns_a_linear_world():
    torch.manual_seed(0)
    reward = GenerativeReward.for_vectors(2, Bounded(-1, 1, shape=(1,)), normalise="demo_range")
    s, a = torch.rand(512, 2) * 2 - 1, torch.rand(512, 1) * 2 - 1
    batch = TensorDict(
        {"observation": s, "action": a, "next": {"observation": 0.5 * s + 0.5 * a}}, [512]
    )
    reward.scaler.fit(s)
    untrained = reward(batch)["next", "intrinsic_reward"].mean().item()
    loss = GenerativeRewardLoss(reward, alpha=10.0)
    optimiser = torch.optim.Adam(loss.parameters(), lr=3e-3)
    for _ in range(300):
        optimiser.zero_grad()
        sum(loss(batch[torch.randint(512, (64,))]).values()).backward()
        optimiser.step()
    with torch.no_grad():
        seen = reward(batch)["next", "intrinsic_reward"].mean().item()
        batch["action"] = -batch["action"]
        unseen = reward(batch)["next", "intrinsic_reward"].mean().item()
    assert seen < 0.5 * untrained
    assert unseen > 2 * seen


def test_nested_keys_set_keys_and_dispatch():
    keys = [("agent", "observation"), ("agent", "action"), ("next", "agent", "observation")]
    batch = batch_for("box", 6)
    moved = TensorDict(
        {
            "agent": {"observation": batch["observation"], "action": batch["action"]},
            "next": {"agent": {"observation": batch["next", "observation"]}},
        },
        [6],
    )
    loss = make(reward_kwargs={"normalise": "raw"})
    nested = make(reward_kwargs={"normalise": "raw", "in_keys": keys})
    assert nested.in_keys == keys
    torch.manual_seed(0)
    expected = loss(batch)
    torch.manual_seed(0)
    assert (nested(moved) == expected).all()
    loss.set_keys(observation=keys[0], action=keys[1], next_observation=keys[2])
    torch.manual_seed(0)
    assert (loss(moved) == expected).all()
    loss.set_keys(observation="observation", action="action", next_observation=("next", "o"))
    torch.manual_seed(0)
    called = loss(
        observation=batch["observation"],
        action=batch["action"],
        next_o=batch["next", "observation"],
    )
    assert torch.equal(torch.stack(called), torch.stack([expected[k] for k in loss.out_keys]))


def test_padding_mask_is_respected():
    batch = batch_for("box", 4)
    batch["shifted_valid"] = torch.tensor([True, True, False, True])
    batch["next", "observation"][2] = torch.nan
    assert all(value.isfinite() for value in make()(batch).values())


def test_state_round_trip():
    one, two = make(), make(reward_kwargs={"seed": 5})
    two.load_state_dict(one.state_dict())
    batch = batch_for("box", 6)
    torch.manual_seed(0)
    expected = one(batch)
    torch.manual_seed(0)
    assert (two(batch) == expected).all()


def test_bad_arguments():
    with pytest.raises(UserError, match="reduction"):
        make(reduction="median")
    with pytest.raises(UserError, match="alpha"):
        make(alpha=-1.0)
