import pytest
import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded, Categorical, OneHot

from giril_rl.errors import UserError
from giril_rl.graphs import TracedGradients
from giril_rl.rewards import (
    ActionEncoder,
    CuriosityReward,
    CuriosityRewardLoss,
    ObservationScaler,
)

SPECS = {"box": Bounded(-2.0, 2.0, shape=(2,)), "discrete": Categorical(4), "one_hot": OneHot(4)}
PARTS = ("features", "inverse_model", "forward_model")


def batch_for(kind, *shape):
    if kind == "box":
        action = 3 * torch.randn(*shape, 2)
    else:
        action = torch.randint(4, shape)
        if kind == "one_hot":
            action = F.one_hot(action, 4).bool()
    return TensorDict(
        {
            "observation": torch.randn(*shape, 3),
            "action": action,
            "next": {"observation": torch.randn(*shape, 3)},
        },
        shape,
    )


def make(kind="box", reward_kwargs=None, **kwargs):
    reward = CuriosityReward.for_vectors(3, SPECS[kind], **(reward_kwargs or {}))
    reward.scaler.fit(torch.randn(50, 3) * 2 + 1)
    return CuriosityRewardLoss(reward, **kwargs)


def test_both_terms_by_hand():
    # phi(s) = 2s, a_hat = phi(s') - phi(s), phi_hat(s') = phi(s) + a
    class Fixed(nn.Module):
        def __init__(self, function):
            super().__init__()
            self.function = function

        def forward(self, *x):
            return self.function(torch.cat(x, -1))

    reward = CuriosityReward(
        Fixed(lambda s: 2 * s),
        Fixed(lambda x: x[..., 2:] - x[..., :2]),
        Fixed(lambda x: x[..., :2] + x[..., 2:]),
        scaler=ObservationScaler(2, rule="raw", clamp=False),
        actions=ActionEncoder(Bounded(-1.0, 1.0, shape=(2,))),
        scale=7.0,  # The paper's lambda weighs the reward, not its training.
    )
    batch = TensorDict(
        {
            "observation": torch.tensor([[0.0, 1.0]]),
            "action": torch.tensor([[0.5, -0.5]]),
            "next": {"observation": torch.tensor([[1.0, 0.5]])},
        },
        [1],
    )
    out = CuriosityRewardLoss(reward)(batch)
    # a_hat (2, -1), a (0.5, -0.5): (2.25 + 0.25) / 2;  phi_hat (0.5, 1.5), phi' (2, 1): 2.5
    assert out["loss_inverse"].item() == 1.25
    assert out["loss_forward"].item() == 2.5


@pytest.mark.parametrize("kind", SPECS)
def test_the_objective_independently(kind):
    loss = make(kind, reduction="none")
    batch, reward = batch_for(kind, 4, 5), loss.reward
    out = loss(batch)
    assert out.batch_size == (4, 5)
    demo = reward.scaler
    s = ((batch["observation"] - demo.offset) * demo.scale).clamp(-1, 1)
    s_next = ((batch["next", "observation"] - demo.offset) * demo.scale).clamp(-1, 1)
    phi, phi_next = reward.features(s), reward.features(s_next)
    guess = reward.inverse_model(torch.cat((phi, phi_next), -1))
    if kind == "box":
        code = batch["action"].clamp(-2, 2) / 2
        inverse = F.mse_loss(guess, code, reduction="none").mean(-1)
    else:
        index = batch["action"] if kind == "discrete" else batch["action"].int().argmax(-1)
        code = torch.eye(4)[index]
        inverse = F.cross_entropy(guess.flatten(0, 1), index.flatten(), reduction="none")
    predicted = reward.forward_model(torch.cat((phi, code), -1))
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
    loss, batch = make(kind, features=features), batch_for(kind, 16)
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
@pytest.mark.parametrize("kind", SPECS)
def test_the_recorded_graph_has_the_same_gradients(kind, features):
    loss, batch = make(kind, features=features), batch_for(kind, 8)
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
    noise = 0.3 * torch.randn(256, 2)  # Nothing can foresee it, so that small features pay.
    batch = TensorDict(
        {"observation": s, "action": a, "next": {"observation": s + 0.1 * a + noise}}, [256]
    )
    spread = {}
    for features in ("inverse", "both", "none"):
        reward = CuriosityReward.for_vectors(
            2, Bounded(-1, 1, shape=(1,)), normalise="raw", hidden=[20, 20], seed=0
        )
        loss = CuriosityRewardLoss(reward, features=features)
        optimiser = torch.optim.Adam(loss.parameters(), lr=1e-2)
        for _ in range(150):
            optimiser.zero_grad()
            sum(loss(batch).values()).backward()
            optimiser.step()
        with torch.no_grad():
            spread[features] = reward.features(s).std(0).mean().item()
    assert spread["both"] < 0.5 * spread["none"]
    assert spread["inverse"] > 0.8 * spread["none"]


def test_it_learns_a_linear_world():
    torch.manual_seed(0)
    reward = CuriosityReward.for_vectors(2, Bounded(-1, 1, shape=(1,)), normalise="demo_range")
    s, a = torch.rand(512, 2) * 2 - 1, torch.rand(512, 1) * 2 - 1
    batch = TensorDict(
        {"observation": s, "action": a, "next": {"observation": 0.5 * s + 0.5 * a}}, [512]
    )
    reward.scaler.fit(s)
    loss = CuriosityRewardLoss(reward)
    untrained = {k: v.item() for k, v in loss(batch).items()}
    optimiser = torch.optim.Adam(loss.parameters(), lr=3e-3)
    for _ in range(200):
        optimiser.zero_grad()
        sum(loss(batch[torch.randint(512, (64,))]).values()).backward()
        optimiser.step()
    with torch.no_grad():
        trained = {k: v.item() for k, v in loss(batch).items()}
        seen = reward(batch)["next", "intrinsic_reward"].mean().item()
        batch["action"] = -batch["action"]
        unseen = reward(batch)["next", "intrinsic_reward"].mean().item()
    assert seen == pytest.approx(trained["loss_forward"])
    for name, value in trained.items():
        assert value < 0.2 * untrained[name]
    assert unseen > 2 * seen


def test_reductions():
    torch.manual_seed(0)
    batch = batch_for("box", 8)
    kwargs = {"normalise": "raw"}
    values = {r: make(reduction=r, reward_kwargs=kwargs)(batch) for r in ("none", "mean", "sum")}
    for key, term in values["none"].items():
        assert term.shape == (8,)
        torch.testing.assert_close(values["mean"][key], term.mean())
        torch.testing.assert_close(values["sum"][key], term.sum())


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
    expected = loss(batch)
    nested = make(reward_kwargs={"normalise": "raw", "in_keys": keys})
    assert nested.in_keys == keys
    assert (nested(moved) == expected).all()
    loss.set_keys(observation=keys[0], action=keys[1], next_observation=keys[2])
    assert (loss(moved) == expected).all()
    loss.set_keys(observation="observation", action="action", next_observation=("next", "o"))
    called = loss(
        observation=batch["observation"],
        action=batch["action"],
        next_o=batch["next", "observation"],
    )
    assert torch.equal(torch.stack(called), torch.stack([expected[k] for k in loss.out_keys]))


def test_bad_names():
    with pytest.raises(UserError, match="reduction='median' is unknown"):
        make(reduction="median")
    with pytest.raises(UserError, match="features='all' is unknown: choose inverse, both or none"):
        make(features="all")
