import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded, Categorical

from giril_rl.errors import UserError
from giril_rl.rewards import ActionEncoder, CuriosityReward, ObservationScaler, feature_error


class Fixed(nn.Module):
    """A network that is a plain function."""

    def __init__(self, function):
        super().__init__()
        self.function = function

    def forward(self, *x):
        return self.function(torch.cat(x, -1))


def make(discrete=False, **kwargs):
    spec = Categorical(4) if discrete else Bounded(-1.0, 1.0, shape=(1,))
    return CuriosityReward.for_vectors(3, spec, **{"normalise": "raw", "clamp": False, **kwargs})


def transitions(*batch, discrete=False):
    action = torch.randint(4, batch) if discrete else 3 * torch.randn(*batch, 1)
    observation, following = torch.randn(*batch, 3), torch.randn(*batch, 3)
    return TensorDict(
        {"observation": observation, "action": action, "next": {"observation": following}}, batch
    )


def test_feature_error_by_hand():
    error = feature_error(torch.tensor([[1.0, -1.0], [0.5, 0.0]]), torch.tensor([3.0, 0.0]))
    assert error.tolist() == [5.0, 6.25]


def test_the_equation_by_hand():
    # phi(s) = s^2; forward: phi + code; action 6 is executed as 4, the bound, whose code is 1
    reward = CuriosityReward(
        Fixed(lambda s: s.square()),
        Fixed(lambda x: x),
        Fixed(lambda x: x[..., :-1] + x[..., -1:]),
        scaler=ObservationScaler(2, rule="raw", clamp=False),
        actions=ActionEncoder(Bounded(0.0, 4.0, shape=(1,))),
        scale=0.5,
    )
    batch = TensorDict(
        {
            "observation": torch.tensor([[1.0, -2.0], [0.0, 0.0]]),
            "action": torch.tensor([[6.0], [3.0]]),
            "next": {"observation": torch.tensor([[2.0, 1.0], [0.5, -1.0]])},
        },
        [2],
    )
    # phi_hat (2, 5) - phi' (4, 1) = (-2, 4): 20 / 2;  (0.5, 0.5) - (0.25, 1) = (0.25, -0.5)
    assert reward(batch)["next", "intrinsic_reward"].tolist() == [[10.0], [0.3125 / 2]]


def test_a_discrete_action_enters_as_one_hot():
    reward = CuriosityReward(
        nn.Identity(),
        nn.Identity(),
        Fixed(lambda x: x[..., 1:]),
        scaler=ObservationScaler(1, rule="raw", clamp=False),
        actions=ActionEncoder(Categorical(3)),
    )
    code = reward.actions(torch.tensor([2]))
    assert reward.predict(torch.zeros(1, 1), code).tolist() == [[0.0, 0.0, 1.0]]


def test_both_observations_are_scaled_and_clamped():
    seen = []
    reward = CuriosityReward(
        Fixed(lambda s: seen.append(s) or s),
        nn.Identity(),
        Fixed(lambda x: x[..., :1]),
        scaler=ObservationScaler(1, rule="demo_range").fit(torch.tensor([[0.0], [4.0]])),
        actions=ActionEncoder(Bounded(-1.0, 1.0, shape=(1,))),
    )
    batch = TensorDict(
        {
            "observation": torch.tensor([[3.0]]),
            "action": torch.zeros(1, 1),
            "next": {"observation": torch.tensor([[-50.0]])},
        },
        [1],
    )
    assert reward(batch)["next", "intrinsic_reward"].tolist() == [[2.25]]
    assert [s.item() for s in seen] == [0.5, -1.0]


def test_the_inverse_model_takes_no_part_in_the_reward():
    reward, batch = make(), transitions(8)
    first = reward(batch)["next", "intrinsic_reward"]
    with torch.no_grad():
        for parameter in reward.inverse_model.parameters():
            parameter.fill_(torch.nan)
    assert torch.equal(reward(batch)["next", "intrinsic_reward"], first)


def test_shapes_of_the_paper_bodies():
    reward = make(discrete=True)
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
    reward, batch = make(hidden=[], model_hidden=[]), transitions(5)
    code = reward.actions(batch["action"])
    predicted = reward.forward_model(torch.cat((batch["observation"], code), -1))
    expected = (predicted - batch["next", "observation"]).pow(2).sum(-1, keepdim=True)
    torch.testing.assert_close(reward(batch)["next", "intrinsic_reward"], expected)


def test_seed_decides_the_weights_alone():
    before = torch.get_rng_state()
    a, b, c = make(seed=1), make(seed=1), make(seed=2)
    assert torch.equal(torch.get_rng_state(), before)
    for part in ("features", "inverse_model", "forward_model"):
        weights = [getattr(reward, part)[0].weight for reward in (a, b, c)]
        assert torch.equal(weights[0], weights[1]) and not torch.equal(weights[0], weights[2])


def test_dispatch():
    reward, batch = make(), transitions(6)
    expected = reward(batch)["next", "intrinsic_reward"]
    called = reward(
        observation=batch["observation"],
        action=batch["action"],
        next_observation=batch["next", "observation"],
    )
    assert torch.equal(called, expected)


def test_bad_names():
    with pytest.raises(UserError, match="normalise"):
        make(normalise="minmax")
    with pytest.raises(UserError, match="in_keys"):
        make(in_keys=["observation"])
