"""CDIL's reward and loss, of vectors and of frames, against the equations written out."""

import pytest
import torch
import torch.nn.functional as F
from reward_data import (
    ACTIONS,
    NESTED,
    SPECS,
    Fixed,
    convolved,
    frames,
    nested,
    run_in,
    scaled,
    train,
    transition,
    vectors,
)
from torch import nn
from torchrl.data import Bounded, Categorical

from giril_rl.errors import UserError
from giril_rl.graphs.gradients import TracedGradients
from giril_rl.rewards import (
    ActionEncoder,
    CuriosityReward,
    CuriosityRewardLoss,
    ObservationScaler,
    feature_error,
    transitions,
)

PARTS = ("features", "inverse_model", "forward_model")
ONE = Bounded(-1.0, 1.0, shape=(1,))


def make(kind="box", **kwargs):
    kwargs = {"normalise": "raw", "clamp": False, **kwargs}
    return CuriosityReward.for_vectors(3, SPECS[kind], **kwargs)


def loss_of(kind="box", reward_kwargs=None, **kwargs):
    reward = CuriosityReward.for_vectors(3, SPECS[kind], **(reward_kwargs or {}))
    reward.scaler.fit(torch.randn(50, 3) * 2 + 1)
    return CuriosityRewardLoss(reward, **kwargs)


def reward_of(module, batch):
    return module(batch.clone())["next", "intrinsic_reward"]


# The reward


def test_feature_error_by_hand():
    error = feature_error(torch.tensor([[1.0, -1.0], [0.5, 0.0]]), torch.tensor([3.0, 0.0]))
    assert error.tolist() == [5.0, 6.25]


def test_the_equation_by_hand():
    # phi(s) = s^2; forward: phi + a; action 6 is executed as 4, the bound, which is encoded as 1
    reward = CuriosityReward(
        Fixed(lambda s: s.square()),
        Fixed(lambda x: x),
        Fixed(lambda x: x[..., :-1] + x[..., -1:]),
        scaler=ObservationScaler(2, rule="raw", clamp=False),
        actions=ActionEncoder(Bounded(0.0, 4.0, shape=(1,))),
        scale=0.5,
    )
    s, s_next = torch.tensor([[[1.0, -2.0], [0.0, 0.0]], [[2.0, 1.0], [0.5, -1.0]]])
    batch = transition(s, torch.tensor([[6.0], [3.0]]), s_next)
    # phi_hat (2, 5) - phi' (4, 1) = (-2, 4): 20 / 2;  (0.5, 0.5) - (0.25, 1) = (0.25, -0.5)
    assert reward_of(reward, batch).tolist() == [[10.0], [0.3125 / 2]]


def test_a_discrete_action_enters_as_one_hot():
    reward = CuriosityReward(
        nn.Identity(),
        nn.Identity(),
        Fixed(lambda x: x[..., 1:]),
        scaler=ObservationScaler(1, rule="raw", clamp=False),
        actions=ActionEncoder(Categorical(3)),
    )
    encoding = reward.actions(torch.tensor([2]))
    assert reward.predict(torch.zeros(1, 1), encoding).tolist() == [[0.0, 0.0, 1.0]]


def test_both_observations_are_scaled_and_clamped():
    seen = []
    reward = CuriosityReward(
        Fixed(lambda s: seen.append(s) or s),
        nn.Identity(),
        Fixed(lambda x: x[..., :1]),
        scaler=ObservationScaler(1, rule="demo_range").fit(torch.tensor([[0.0], [4.0]])),
        actions=ActionEncoder(ONE),
    )
    batch = transition(torch.tensor([[3.0]]), torch.zeros(1, 1), torch.tensor([[-50.0]]))
    assert reward_of(reward, batch).tolist() == [[2.25]]
    assert [s.item() for s in seen] == [0.5, -1.0]


def test_the_inverse_model_plays_no_role_in_the_reward():
    reward, batch = make(), vectors(8)
    first = reward_of(reward, batch)
    with torch.no_grad():
        for parameter in reward.inverse_model.parameters():
            parameter.fill_(torch.nan)
    assert torch.equal(reward_of(reward, batch), first)


def test_shapes_of_the_papers_networks():
    reward = make("discrete")
    assert [type(layer) for layer in reward.features] == [nn.Linear, nn.Tanh] * 2
    for body, sizes in (
        (reward.features, [(3, 100), (100, 100)]),
        (reward.inverse_model, [(200, 100), (100, 4)]),
        (reward.forward_model, [(104, 100), (100, 100)]),
    ):
        linear = [layer for layer in body if isinstance(layer, nn.Linear)]
        assert [(layer.in_features, layer.out_features) for layer in linear] == sizes
    features = reward.features(100 * torch.randn(50, 3))
    assert features.abs().max() <= 1
    assert reward.invert(features, features).shape == (50, 4)


def test_without_layers_features_are_the_scaled_observation():
    reward, batch = make(hidden=[], model_hidden=[]), vectors(5)
    encoding = reward.actions(batch["action"])
    predicted = reward.forward_model(torch.cat((batch["observation"], encoding), -1))
    expected = (predicted - batch["next", "observation"]).pow(2).sum(-1, keepdim=True)
    torch.testing.assert_close(reward_of(reward, batch), expected)


# The loss


def test_both_terms_by_hand():
    # phi(s) = 2s, a_hat = phi(s') - phi(s), phi_hat(s') = phi(s) + a
    reward = CuriosityReward(
        Fixed(lambda s: 2 * s),
        Fixed(lambda x: x[..., 2:] - x[..., :2]),
        Fixed(lambda x: x[..., :2] + x[..., 2:]),
        scaler=ObservationScaler(2, rule="raw", clamp=False),
        actions=ActionEncoder(Bounded(-1.0, 1.0, shape=(2,))),
        scale=7.0,  # The paper's lambda weighs the reward, not its training.
    )
    s, action, s_next = torch.tensor([[[0.0, 1.0]], [[0.5, -0.5]], [[1.0, 0.5]]])
    out = CuriosityRewardLoss(reward)(transition(s, action, s_next))
    # a_hat (2, -1), a (0.5, -0.5): (2.25 + 0.25) / 2;  phi_hat (0.5, 1.5), phi' (2, 1): 2.5
    assert out["loss_inverse"].item() == 1.25
    assert out["loss_forward"].item() == 2.5


@pytest.mark.parametrize("kind", SPECS)
def test_the_objective_independently(kind):
    loss = loss_of(kind, reduction="none")
    batch, reward = vectors(4, 5, kind=kind), loss.reward
    out = loss(batch)
    assert out.batch_size == (4, 5)
    demo = reward.scaler
    s = ((batch["observation"] - demo.offset) * demo.scale).clamp(-1, 1)
    s_next = ((batch["next", "observation"] - demo.offset) * demo.scale).clamp(-1, 1)
    phi, phi_next = reward.features(s), reward.features(s_next)
    guess = reward.inverse_model(torch.cat((phi, phi_next), -1))
    if kind == "box":
        encoding = batch["action"].clamp(-2, 2) / 2
        inverse = F.mse_loss(guess, encoding, reduction="none").mean(-1)
    else:
        index = batch["action"] if kind == "discrete" else batch["action"].int().argmax(-1)
        encoding = torch.eye(4)[index]
        inverse = F.cross_entropy(guess.flatten(0, 1), index.flatten(), reduction="none")
    predicted = reward.forward_model(torch.cat((phi, encoding), -1))
    error = torch.linalg.vector_norm(predicted - phi_next, dim=-1) ** 2
    torch.testing.assert_close(out["loss_inverse"], inverse.view(4, 5))
    torch.testing.assert_close(out["loss_forward"], error)


def gradients(loss, batch, term):
    """Whether ``term`` alone moves each part of the module."""
    loss.zero_grad()
    value = loss(batch)[term]
    if not value.requires_grad:
        return dict.fromkeys(PARTS, False)
    value.backward()
    return {
        part: any(
            p.grad is not None and p.grad.abs().sum() > 0
            for p in getattr(loss.reward, part).parameters()
        )
        for part in PARTS
    }


@pytest.mark.parametrize("kind", SPECS)
@pytest.mark.parametrize(
    ("features", "by_inverse", "by_forward"),
    [("inverse", True, False), ("both", True, True), ("none", False, False)],
)
def test_which_loss_trains_which_part(kind, features, by_inverse, by_forward):
    loss, batch = loss_of(kind, features=features), vectors(16, kind=kind)
    assert gradients(loss, batch, "loss_inverse") == {
        "features": by_inverse,
        "inverse_model": True,
        "forward_model": False,
    }
    assert gradients(loss, batch, "loss_forward") == {
        "features": by_forward,
        "inverse_model": False,
        "forward_model": True,
    }


@pytest.mark.parametrize("features", ["inverse", "both", "none"])
@pytest.mark.parametrize("kind", ["box", "one_hot"])
def test_the_recorded_graph_has_the_same_gradients(kind, features):
    loss, batch = loss_of(kind, features=features), vectors(8, kind=kind)
    recorded = TracedGradients(loss, keys=loss.in_keys)
    out = recorded(batch)
    traced = [p.grad.clone() for p in recorded.parameters]
    loss.zero_grad()
    expected = loss(batch)
    sum(expected.values()).backward()
    for name, value in expected.items():
        torch.testing.assert_close(out[name], value.detach())
    for gradient, parameter in zip(traced, recorded.parameters, strict=True):
        plain = torch.zeros_like(gradient) if parameter.grad is None else parameter.grad
        torch.testing.assert_close(gradient, plain)


def test_features_shrink_where_both_losses_train_them():
    """The pull that the docs warn of; without it the features keep what the action needs."""
    torch.manual_seed(0)
    s, a = torch.rand(256, 2) * 2 - 1, torch.rand(256, 1) * 2 - 1
    noise = 0.3 * torch.randn(256, 2)  # Nothing can predict it, so small features pay.
    batch, spread = transition(s, a, s + 0.1 * a + noise), {}
    for features in ("inverse", "both", "none"):
        reward = CuriosityReward.for_vectors(2, ONE, normalise="raw", hidden=[20, 20], seed=0)
        train(CuriosityRewardLoss(reward, features=features), batch, steps=150, lr=1e-2)
        with torch.no_grad():
            spread[features] = reward.features(s).std(0).mean().item()
    assert spread["both"] < 0.5 * spread["none"]
    assert spread["inverse"] > 0.8 * spread["none"]


def test_it_learns_a_linear_world():
    torch.manual_seed(0)
    reward = CuriosityReward.for_vectors(2, ONE, normalise="demo_range")
    s, a = torch.rand(512, 2) * 2 - 1, torch.rand(512, 1) * 2 - 1
    batch = transition(s, a, 0.5 * s + 0.5 * a)
    reward.scaler.fit(s)
    loss = CuriosityRewardLoss(reward)
    untrained = {k: v.item() for k, v in loss(batch).items()}
    train(loss, batch, steps=200, lr=3e-3, size=64)
    with torch.no_grad():
        trained = {k: v.item() for k, v in loss(batch).items()}
        seen = reward_of(reward, batch).mean().item()
        batch["action"] = -batch["action"]
        unseen = reward_of(reward, batch).mean().item()
    assert seen == pytest.approx(trained["loss_forward"])
    for name, value in trained.items():
        assert value < 0.2 * untrained[name]
    assert unseen > 2 * seen


def test_nested_keys():
    loss, batch = loss_of(reward_kwargs={"normalise": "raw", "in_keys": NESTED}), vectors(6)
    assert loss.in_keys == NESTED
    assert (loss(nested(batch)) == loss_of(reward_kwargs={"normalise": "raw"})(batch)).all()


def test_bad_arguments():
    for key, value in {"normalise": "minmax", "in_keys": ["observation"]}.items():
        with pytest.raises(UserError, match=key):
            make(**{key: value})
    with pytest.raises(UserError, match="reduction='median' is unknown"):
        loss_of(reduction="median")
    with pytest.raises(UserError, match="features='all' is unknown: choose inverse, both or none"):
        loss_of(features="all")


# Frames


def of_frames(**kwargs):
    return CuriosityReward.for_pixels(Categorical(ACTIONS), **kwargs)


def two_layers(network, *parts):
    """Linear, leaky ReLU, linear."""
    first, second = network[0], network[2]
    x = F.leaky_relu(F.linear(torch.cat(parts, -1), first.weight, first.bias), 0.01)
    return F.linear(x, second.weight, second.bias)


@torch.no_grad()
def by_hand(reward, data):
    """Both losses of each transition."""
    body = reward.features.body
    phi, phi_next = (
        convolved(body, scaled(data[key])) for key in ("observation", ("next", "observation"))
    )
    guess = two_layers(reward.inverse_model, phi, phi_next)
    inverse = F.cross_entropy(guess, data["action"], reduction="none")
    encoding = F.one_hot(data["action"], ACTIONS).float()
    predicted = two_layers(reward.forward_model, phi, encoding)
    return inverse, F.mse_loss(predicted, phi_next, reduction="none").sum(-1)


def test_losses_and_reward_of_frames_by_hand_in_eval_mode():
    reward, data = of_frames(scale=0.3, seed=1), frames(6)
    loss = run_in(CuriosityRewardLoss(reward, reduction="none"), data)
    inverse, error = by_hand(reward, data)
    with torch.no_grad():
        out = loss(data)
        paid = reward_of(reward, data)
    torch.testing.assert_close(out["loss_inverse"], inverse, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(out["loss_forward"], error, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(paid, 0.3 * error.unsqueeze(-1), rtol=1e-4, atol=1e-4)


def test_in_eval_mode_only_the_statistics_count_and_in_training_the_batch():
    reward, data = of_frames(), frames(6)
    run_in(CuriosityRewardLoss(reward), data)
    paid = {}
    with torch.no_grad():
        for mode in (False, True):
            reward.train(mode)
            paid[mode] = [reward_of(reward, data[:n]) for n in (6, 3)]
    torch.testing.assert_close(paid[False][0][:3], paid[False][1], rtol=1e-5, atol=1e-6)
    assert not torch.isclose(paid[True][0][:3], paid[True][1], rtol=1e-2).any()


def test_many_transitions_are_taken_some_at_a_time(monkeypatch):
    reward, data = of_frames().eval(), frames(2, 3)
    with torch.no_grad():
        whole = reward_of(reward, data)
        monkeypatch.setattr(transitions, "PIXELS_AT_ONCE", 4)
        sizes = []
        reward.features.register_forward_hook(lambda _, inputs, out: sizes.append(len(out)))
        parts = reward_of(reward, data)
    assert sizes == [4, 4, 2, 2]
    torch.testing.assert_close(parts, whole, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("features", ["inverse", "both", "none"])
def test_the_losses_of_frames_fall_within_a_few_steps(features):
    loss, data = CuriosityRewardLoss(of_frames(), features=features), frames(8)
    first = loss.reward.features.body[0].weight.clone()
    totals = train(loss, data, steps=8, lr=1e-3)
    assert totals[-1] < 0.8 * totals[0]
    moved = not torch.equal(loss.reward.features.body[0].weight, first)
    assert moved == (features != "none")
