"""GIRIL's reward and loss of frames against the equations written out."""

import copy

import pytest
import torch
import torch.nn.functional as F
from reward_data import ACTIONS, convolved, decoded, frames, run_in, scaled, train, transition
from torch import nn
from torch.distributions import Independent, Normal, kl_divergence
from torchrl.data import Bounded, Categorical

from giril_rl.errors import UserError
from giril_rl.networks.pixel_decoder import PixelDecoder
from giril_rl.networks.pixels import PixelEncoder
from giril_rl.rewards import (
    ActionEncoder,
    GenerativeReward,
    GenerativeRewardLoss,
    PixelScaler,
    transitions,
)


def model(**kwargs):
    """A reward whose prediction leaves [-1, 1] here and there."""
    reward = GenerativeReward.for_pixels(Categorical(ACTIONS), **kwargs)
    with torch.no_grad():
        reward.decoder.last.weight.mul_(4)
    return reward


def factored(reward, data):
    """The reward as PPO gets it."""
    with torch.no_grad():
        return reward(data.clone())["next", "intrinsic_reward"]


def literal(reward, data):
    """The reward where gradients are wanted: the whole decoder for each transition."""
    return reward(data.clone())["next", "intrinsic_reward"].detach()


# Both ways to the reward at beta = 1


@pytest.mark.parametrize("clamp", [True, False])
@pytest.mark.parametrize("batch", [(6,), (2, 3), ()])
def test_the_factored_way_is_the_literal_one(clamp, batch):
    reward, data = model(clamp=clamp, scale=0.3), frames(*batch)
    calls = []
    reward.decoder.register_forward_hook(lambda *_: calls.append(1))
    expected = literal(reward, data)
    assert len(calls) == 1
    found = factored(reward, data)
    assert len(calls) == 1  # Not the decoder as it is.
    assert found.shape == (*batch, 1)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=0)
    by_hand = decoded(
        reward.decoder,
        torch.eye(ACTIONS)[data["action"]].reshape(-1, ACTIONS),
        scaled(data["observation"]).reshape(-1, 4, 84, 84),
    )
    by_hand = by_hand.clamp(-1, 1) if clamp else by_hand
    error = by_hand - scaled(data["next", "observation"]).reshape(by_hand.shape)
    error = 0.3 * error.square().sum((-3, -2, -1)).reshape(*batch, 1)
    torch.testing.assert_close(found, error.detach(), rtol=1e-5, atol=0)


@pytest.mark.parametrize("clamp", [True, False])
@pytest.mark.parametrize("batch", [(20,), (2, 3), ()])
def test_with_beta_below_1_the_two_parts_are_the_literal_network(clamp, batch):
    reward, data = model(clamp=clamp, beta=0.9, scale=0.3).eval(), frames(*batch)
    calls, noise = [], reward.get_extra_state()
    reward.decoder.register_forward_hook(lambda *_: calls.append(1))
    expected = literal(reward, data)
    assert len(calls) == 1
    drawn = reward.get_extra_state()
    assert not torch.equal(drawn, noise)
    reward.set_extra_state(noise)
    found = factored(reward, data)
    assert len(calls) == 1 and torch.equal(reward.get_extra_state(), drawn)
    assert found.shape == (*batch, 1)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=0)


class DarkScaler(PixelScaler):
    """Half the contrast, darker."""

    def forward(self, observation):
        return 0.5 * super().forward(observation) - 0.25


class AddingDecoder(PixelDecoder):
    """Predicts the change."""

    def forward(self, code, observation):
        return super().forward(code, observation) + observation


class SmoothActions(ActionEncoder):
    """Not quite one-hot."""

    def forward(self, action):
        return 0.9 * super().forward(action) + 0.025


def of_parts(actions, scaler=None, decoder=PixelDecoder, **kwargs):
    torch.manual_seed(0)
    parts = PixelEncoder(actions.size), decoder(actions.size)
    with torch.no_grad():
        parts[1].last.weight.mul_(4)
        parts[1].painter[0].weight.mul_(100)  # The action matters.
    return GenerativeReward(*parts, scaler=scaler or PixelScaler(), actions=actions, **kwargs)


DISCRETE, BOX = Categorical(ACTIONS), Bounded(-2.0, 2.0, shape=(3,))


@pytest.mark.parametrize("beta", [1.0, 0.9])
@pytest.mark.parametrize(
    "parts",
    [
        {"actions": ActionEncoder(BOX)},
        {"actions": ActionEncoder(BOX), "scaler": PixelScaler(clamp=False)},
        {"actions": ActionEncoder(DISCRETE), "scaler": DarkScaler()},
        {"actions": ActionEncoder(DISCRETE), "decoder": AddingDecoder},
        {"actions": SmoothActions(DISCRETE)},
    ],
    ids=["box", "box, not clamped", "scaler", "decoder", "actions"],
)
def test_parts_that_compute_something_else_get_their_own_error(parts, beta):
    reward, data = of_parts(**parts, beta=beta).eval(), frames(2, 3)
    if not reward.actions.discrete:
        data["action"] = 3 * torch.randn(2, 3, 3)
    noise = reward.get_extra_state()
    found = factored(reward, data)
    reward.set_extra_state(noise)
    torch.testing.assert_close(found, literal(reward, data), rtol=1e-5, atol=0)
    with torch.no_grad():
        reward.set_extra_state(noise)
        states = data["observation"], data["action"], data["next", "observation"]
        error = (reward.predict(*states) - reward.scaler(states[2])).square().sum((-3, -2, -1))
    torch.testing.assert_close(found.squeeze(-1), error, rtol=1e-5, atol=0)


def test_channels_come_first():
    reward, data = model(), frames(3)
    for key in ("observation", ("next", "observation")):
        data[key] = data[key].permute(0, 2, 3, 1)
    for way in (factored, literal):
        with pytest.raises(UserError, match=r"\(3, 84, 84, 4\)"):
            way(reward, data)


def test_the_clamp_matters_here():
    data = frames(3)
    assert (factored(model(), data) < 0.9 * factored(model(clamp=False), data)).all()


@pytest.mark.parametrize("beta", [1.0, 0.9])
def test_the_literal_way_takes_some_transitions_at_a_time(beta, monkeypatch):
    reward, data = model(beta=beta).eval(), frames(2, 3)
    sizes = []
    reward.decoder.register_forward_hook(lambda _, inputs, out: sizes.append(len(out)))
    whole = literal(copy.deepcopy(reward), data)
    monkeypatch.setattr(transitions, "PIXELS_AT_ONCE", 4)
    sizes.clear()
    parts = literal(reward, data)
    assert sizes == [4, 2]
    if beta == 1:
        torch.testing.assert_close(parts, whole, rtol=1e-5, atol=0)


def adam(reward, data):
    optimiser = torch.optim.Adam(reward.decoder.parameters(), lr=1e-2, fused=True)
    reward(data.clone())["next", "intrinsic_reward"].mean().backward()
    optimiser.step()


def load(reward, data):
    reward.load_state_dict(model(seed=5).state_dict())


def through_data(reward, data):
    reward.decoder.last.bias.data.add_(0.5)


def replaced(reward, data):
    reward.decoder.last.bias = nn.Parameter(torch.full((4,), 0.3))


@pytest.mark.parametrize("change", [adam, load, through_data, replaced])
def test_the_weights_may_change_in_between(change):
    reward, data = model(), frames(4)
    before = factored(reward, data)
    change(reward, data)
    after = factored(reward, data)
    assert ((after - before).abs() > 1e-4 * before).all()  # Ten times the tolerance
    torch.testing.assert_close(after, literal(reward, data), rtol=1e-5, atol=0)


def test_a_copy_has_weights_of_its_own():
    reward, data = model(), frames(4)
    before = factored(reward, data)
    twin = copy.deepcopy(reward)
    adam(twin, data)
    torch.testing.assert_close(factored(twin, data), literal(twin, data), rtol=1e-5, atol=0)
    assert torch.equal(factored(reward, data), before)


def test_nothing_is_computed_twice_for_the_same_weights(monkeypatch):
    reward, data = model(), frames(2)
    first = factored(reward, data)
    monkeypatch.setattr(type(reward.decoder), "action_table", None)
    assert torch.equal(factored(reward, data), first)


# Equation 2


class Decoder(nn.Module):
    """Predicts the state plus the encoding's numbers, one for each channel."""

    def forward(self, encoding, s):
        return s + encoding[..., None, None]


class Encoder(nn.Module):
    """Is sure of the second action, whatever it sees."""

    def forward(self, s, following):
        mu = torch.tensor([0.0, 80.0]).expand(*s.shape[:-3], 2)
        return torch.cat((mu, torch.full_like(mu, -80.0)), -1)


@pytest.mark.parametrize(
    ("beta", "clamp", "expected"),
    [
        # s = (-1, 0.6), a (1, 0), s_hat = (0, 0.6), s' = (-1, 1).
        (1.0, True, 1.0 + 0.16),
        (1.0, False, 1.0 + 0.16),
        # The blend is (0.25, 0.75): s_hat = (-0.75, 1.35), which is clamped to 1.
        (0.25, True, 0.0625),
        (0.25, False, 0.0625 + 0.1225),
    ],
)
def test_equation_2_by_hand(beta, clamp, expected):
    reward = GenerativeReward(
        Encoder(),
        Decoder(),
        scaler=PixelScaler(clamp=clamp),
        actions=ActionEncoder(Categorical(2)),
        beta=beta,
        scale=0.5,
    )
    s, s_next = (torch.tensor(x, dtype=torch.uint8).view(1, 2, 1, 1) for x in ([0, 204], [0, 255]))
    data = transition(s, torch.tensor([0]), s_next)
    assert factored(reward, data).item() == pytest.approx(0.5 * expected, rel=1e-5)


# Equation 1


@pytest.mark.parametrize("prior", ["standard", "conditional"])
def test_the_three_terms_by_hand(prior):
    reward = model(prior=prior, scale=0.7, seed=1)
    data = frames(6)
    loss = run_in(GenerativeRewardLoss(reward), data)
    torch.manual_seed(0)
    with torch.no_grad():
        out = loss(data)
        torch.manual_seed(0)
        s, following = scaled(data["observation"]), scaled(data["next", "observation"])
        body, head = reward.encoder.body, reward.encoder.head
        latent = F.linear(convolved(body, torch.cat((s, following), 1)), head.weight, head.bias)
        mu, logvar = latent[:, :ACTIONS], latent[:, ACTIONS:]
        z = mu + torch.exp(logvar / 2) * torch.randn(6, ACTIONS)
        error = F.mse_loss(decoded(reward.decoder, z, s), following, reduction="none")
        p = Normal(torch.zeros_like(mu), torch.ones_like(mu))
        if prior == "conditional":
            network = reward.prior_network
            features = convolved(network.features.body, s)
            given = F.linear(features, network.head.weight, network.head.bias)
            p = Normal(given[:, :ACTIONS], torch.exp(given[:, ACTIONS:] / 2))
        q = Independent(Normal(mu, torch.exp(logvar / 2)), 1)
        kl = kl_divergence(q, Independent(p, 1))
        entropy = F.cross_entropy(z, data["action"])
    expected = {
        "loss_reconstruction": 0.7 * error.sum((1, 2, 3)).mean(),
        "loss_kl": kl.mean(),
        "loss_action": 100 * entropy,
    }
    for name, value in expected.items():
        torch.testing.assert_close(out[name], value, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("prior", ["standard", "conditional"])
def test_every_parameter_gets_a_gradient(prior):
    loss = GenerativeRewardLoss(model(prior=prior))
    sum(loss(frames(6)).values()).backward()
    for name, parameter in loss.named_parameters():
        # Batch normalisation takes off what a convolution's bias adds.
        if "body" not in name or not name.endswith("bias"):
            assert parameter.grad is not None and parameter.grad.abs().sum() > 0, name


def test_the_loss_falls_within_a_few_steps():
    torch.manual_seed(0)
    loss, data = GenerativeRewardLoss(model()), frames(8)
    # Even frames, brighter after a higher action: random ones cannot be predicted.
    data["observation"] = data["observation"][..., :1, :1, :1].expand_as(data["observation"])
    brighter = data["observation"] // 2 + 30 * data["action"].view(8, 1, 1, 1).byte()
    data["next", "observation"] = brighter
    totals = train(loss, data, steps=8, lr=1e-3)
    assert totals[-1] < 0.8 * totals[0]
