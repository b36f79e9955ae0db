import copy
import pickle

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded, Categorical

from giril_rl.errors import UserError
from giril_rl.rewards import (
    ActionEncoder,
    GenerativeReward,
    ObservationScaler,
    blend_action,
    reconstruction_error,
)

BOX = Bounded(-1.0, 1.0, shape=(1,))


class Fixed(nn.Module):
    """A network that is a plain function."""

    def __init__(self, function):
        super().__init__()
        self.function = function

    def forward(self, *x):
        return self.function(torch.cat(x, -1))


def transitions(*batch, discrete=False, dim=3):
    action = torch.randint(4, batch) if discrete else 3 * torch.randn(*batch, 1)
    observation, following = torch.randn(*batch, dim), torch.randn(*batch, dim)
    return TensorDict(
        {"observation": observation, "action": action, "next": {"observation": following}}, batch
    )


def make(discrete=False, **kwargs):
    spec = Categorical(4) if discrete else BOX
    kwargs = {"normalise": "raw", "clamp": False, **kwargs}
    return GenerativeReward.for_vectors(3, spec, **kwargs)


def test_pure_functions_by_hand():
    error = reconstruction_error(torch.tensor([[1.0, -1.0], [0.0, 0.0]]), torch.tensor([3.0, 0.0]))
    assert error.tolist() == [5.0, 9.0]
    assert blend_action(torch.tensor([1.0, 0.0]), torch.tensor([0.2, 0.8]), 0.25).tolist() == (
        pytest.approx([0.4, 0.6])
    )


def test_equation_2_by_hand():
    # decoder: s_hat = s + code; action 6 is executed as 4, the bound, whose code is 1
    reward = GenerativeReward(
        Fixed(lambda x: x),
        Fixed(lambda x: x[..., 1:] + x[..., :1]),
        scaler=ObservationScaler(2, rule="raw", clamp=False),
        actions=ActionEncoder(Bounded(0.0, 4.0, shape=(1,))),
        scale=0.5,
    )
    batch = TensorDict(
        {
            "observation": torch.tensor([[1.0, 2.0], [0.0, 0.0]]),
            "action": torch.tensor([[6.0], [3.0]]),
            "next": {"observation": torch.tensor([[5.0, 1.0], [0.5, -0.5]])},
        },
        [2],
    )
    # (2, 3) - (5, 1) = (-3, 2): 13 / 2;  (0.5, 0.5) - (0.5, -0.5) = (0, 1): 1 / 2
    assert reward(batch)["next", "intrinsic_reward"].tolist() == [[6.5], [0.5]]


@pytest.mark.parametrize(("beta", "clamp"), [(1.0, True), (0.5, False)])
def test_the_prediction_is_what_the_reward_compares(beta, clamp):
    reward = make(beta=beta, normalise="standardise", clamp=clamp)
    data = transitions(6)
    reward.scaler.fit(3 * data["observation"] + 1)
    parts = data["observation"], data["action"], data["next", "observation"]
    state = reward.get_extra_state()
    predicted = reward.predict(*parts)
    reward.set_extra_state(state)
    error = reconstruction_error(predicted, reward.scaler(parts[2]))
    assert torch.equal(reward(data)["next", "intrinsic_reward"].squeeze(-1), error)


def test_prediction_is_clamped_with_the_states():
    reward = GenerativeReward(
        Fixed(lambda x: x),
        Fixed(lambda x: x[..., 1:] * 100),
        scaler=ObservationScaler(1, rule="raw", clamp=True),
        actions=ActionEncoder(BOX),
    )
    batch = TensorDict(
        {
            "observation": torch.tensor([[0.7]]),
            "action": torch.zeros(1, 1),
            "next": {"observation": torch.tensor([[-50.0]])},
        },
        [1],
    )
    assert reward(batch)["next", "intrinsic_reward"].tolist() == [[4.0]]


@pytest.mark.parametrize("discrete", [False, True])
def test_blend_uses_the_sampled_latent(discrete):
    # A posterior of (almost) no variance makes z its mean.
    z = torch.tensor([2.0, 0.0, -1.0, 0.5]) if discrete else torch.tensor([0.25])
    k = len(z)
    seen = []
    reward = GenerativeReward(
        Fixed(lambda x: torch.cat((z, torch.full((k,), -80.0))).expand(*x.shape[:-1], -1)),
        Fixed(lambda x: seen.append(x[..., :k]) or x[..., k:]),
        scaler=ObservationScaler(3, rule="raw", clamp=False),
        actions=ActionEncoder(Categorical(4) if discrete else BOX),
        beta=0.75,
    )
    batch = transitions(2, discrete=discrete)
    reward(batch)
    encoded = torch.softmax(z, -1) if discrete else z
    expected = 0.75 * reward.actions(batch["action"]) + 0.25 * encoded
    torch.testing.assert_close(seen[0], expected)


@pytest.mark.parametrize("discrete", [False, True])
@pytest.mark.parametrize("batch", [(), (5,), (2, 5)])
@pytest.mark.parametrize("beta", [1.0, 0.5])
def test_one_reward_per_transition(batch, discrete, beta):
    out = make(discrete, beta=beta)(transitions(*batch, discrete=discrete))
    assert out["next", "intrinsic_reward"].shape == (*batch, 1)


def test_permuting_environments_permutes_rewards():
    reward, batch = make(), transitions(4, 6)
    order = torch.tensor([2, 0, 3, 1])
    whole = reward(batch.clone())["next", "intrinsic_reward"]
    torch.testing.assert_close(reward(batch[order])["next", "intrinsic_reward"], whole[order])


def test_beta_1_ignores_the_encoder_and_the_noise():
    reward, batch = make(), transitions(8)
    first = reward(batch)["next", "intrinsic_reward"]
    with torch.no_grad():
        for parameter in reward.encoder.parameters():
            parameter.fill_(torch.nan)
    assert torch.equal(reward(batch)["next", "intrinsic_reward"], first)


def test_noise_is_private_and_restored():
    batch = transitions(8)
    before = torch.get_rng_state()
    one, two = make(beta=0.5, seed=3), make(beta=0.5, seed=3)
    first = one(batch)["next", "intrinsic_reward"].clone()
    assert torch.equal(torch.get_rng_state(), before)
    assert torch.equal(two(batch)["next", "intrinsic_reward"], first)
    state = one.state_dict()
    assert all(isinstance(v, torch.Tensor) for v in state.values())
    second = one(batch)["next", "intrinsic_reward"].clone()
    assert not torch.equal(second, first)
    fresh = make(beta=0.5, seed=99)
    fresh.load_state_dict(state)
    assert torch.equal(fresh(batch)["next", "intrinsic_reward"], second)


def test_seed_decides_the_weights():
    a, b, c = make(seed=1), make(seed=1), make(seed=2)
    assert torch.equal(a.decoder[0].weight, b.decoder[0].weight)
    assert not torch.equal(a.decoder[0].weight, c.decoder[0].weight)


def test_copies_and_pickles():
    reward, batch = make(beta=0.5), transitions(4)
    twin, thawed = copy.deepcopy(reward), pickle.loads(pickle.dumps(reward))
    expected = reward(batch)["next", "intrinsic_reward"].clone()
    for other in (twin, thawed):
        assert torch.equal(other(batch)["next", "intrinsic_reward"], expected)


def test_shapes_of_the_paper_bodies():
    reward = make(discrete=True, prior="conditional")
    assert [m.out_features for m in reward.encoder if isinstance(m, nn.Linear)] == [100, 100, 8]
    mu, logvar = reward.encode(torch.zeros(5, 3), torch.zeros(5, 3))
    assert mu.shape == logvar.shape == (5, 4)
    assert reward.decode(torch.zeros(5, 4), torch.zeros(5, 3)).shape == (5, 3)
    assert reward.prior(torch.zeros(5, 3))[1].shape == (5, 4)
    assert make().prior(torch.zeros(5, 3)) == (None, None)


def test_nested_keys_and_dispatch():
    keys = [("agent", "observation"), ("agent", "action"), ("next", "agent", "observation")]
    plain, nested = make(), make(in_keys=keys, out_keys=[("next", "agent", "r")])
    batch = transitions(6)
    moved = TensorDict(
        {
            "agent": {"observation": batch["observation"], "action": batch["action"]},
            "next": {"agent": {"observation": batch["next", "observation"]}},
        },
        [6],
    )
    expected = plain(batch)["next", "intrinsic_reward"]
    assert torch.equal(nested(moved)["next", "agent", "r"], expected)
    called = plain(
        observation=batch["observation"],
        action=batch["action"],
        next_observation=batch["next", "observation"],
    )
    assert torch.equal(called, expected)


@pytest.mark.parametrize("beta", [0.0, -0.1, 1.1, float("nan")])
def test_bad_beta(beta):
    with pytest.raises(UserError, match="beta"):
        make(beta=beta)


def test_bad_names():
    with pytest.raises(UserError, match="prior"):
        make(prior="flat")
    with pytest.raises(UserError, match="normalise"):
        make(normalise="minmax")
    with pytest.raises(UserError, match="in_keys"):
        make(in_keys=["observation"])
