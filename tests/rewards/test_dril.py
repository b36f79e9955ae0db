import pytest
import torch
import torch.nn.functional as F
from reward_data import SPECS, total, train, vectors
from torch import nn
from torchrl.data import Bounded, Categorical

from giril_rl.errors import UserError
from giril_rl.networks.ensembles import EnsembleMLP
from giril_rl.rewards.actions import ActionEncoder
from giril_rl.rewards.disagreement import (
    action_variance,
    bootstrapped,
    cloning_losses,
    disagreement_reward,
    state_variance,
)
from giril_rl.rewards.dril import DisagreementLoss, DisagreementReward
from giril_rl.rewards.scaler import ObservationScaler


class Members(nn.Module):
    """An ensemble whose output is given, whatever the observation."""

    def __init__(self, outputs):
        super().__init__()
        self.outputs = nn.Parameter(torch.tensor(outputs))

    def forward(self, observation):
        members, k = self.outputs.shape
        batch = observation.shape[:-1]
        return self.outputs.reshape(members, *[1] * len(batch), k).expand(members, *batch, k)


def of_members(outputs, spec, **kwargs):
    scaler = ObservationScaler(1, rule="raw", clamp=False)
    actions = ActionEncoder(spec)
    return DisagreementReward(Members(outputs), scaler=scaler, actions=actions, **kwargs)


def test_variance_of_an_actions_probability_by_hand():
    odds = [[0.9, 0.1], [0.5, 0.5], [0.7, 0.3]]
    reward = of_members(
        [[torch.tensor(p).log().item() for p in row] for row in odds], Categorical(2)
    )
    variance = reward.variance(torch.zeros(2, 1), torch.tensor([0, 1]))
    # Of 0.9, 0.5, 0.7 about 0.7: 0.08 / 3; the other action's is the same for two actions.
    assert variance.tolist() == pytest.approx([0.08 / 3, 0.08 / 3], rel=1e-5)


def test_variance_of_mean_actions_is_a_quadratic_form():
    members, action = torch.randn(5, 7, 3), torch.randn(7, 3)
    for i in range(7):
        covariance = torch.cov(members[:, i].T, correction=0)
        expected = action[i] @ covariance @ action[i]
        torch.testing.assert_close(action_variance(members, action)[i], expected)
        torch.testing.assert_close(state_variance(members)[i], covariance.trace())


def test_mean_actions_are_clamped_to_the_bounds():
    spec = Bounded(-2.0, 2.0, shape=(1,))
    reward = of_members([[5.0], [1.0]], spec, variance="state")  # Encoded: the bound is 1.
    assert reward.variance(torch.zeros(1, 1), torch.zeros(1, 1)).item() == 0
    reward = of_members([[0.5], [-0.5]], spec)
    # The action 1 is 0.5 as encoded; products are 0.25 and -0.25.
    assert reward.variance(torch.zeros(1, 1), torch.ones(1, 1)).item() == pytest.approx(0.0625)


def test_forms_by_hand():
    v = torch.tensor([0.0, 1.0, 1.5])
    assert disagreement_reward(v, 1.0, "sign").tolist() == [1, 1, -1]
    assert disagreement_reward(v, 1.0, "penalty").tolist() == [0, 0, -1]
    assert disagreement_reward(v, 1.0, "variance").tolist() == [0, -1, -1.5]
    with pytest.raises(UserError, match="form='soft' is unknown"):
        DisagreementReward.for_vectors(2, Categorical(2), form="soft")
    with pytest.raises(UserError, match="variance='both' is unknown"):
        DisagreementReward.for_vectors(2, Categorical(2), variance="both")


@pytest.mark.parametrize("kind", SPECS)
def test_the_threshold_is_the_demonstrations_quantile(kind):
    reward = DisagreementReward.for_vectors(3, SPECS[kind], hidden=[16], normalise="raw")
    pairs = vectors(101, kind=kind)
    reward.calibrate(pairs, 0.9)
    paid = reward(pairs)["next", "intrinsic_reward"]
    assert (paid == 1).sum() == 91 and (paid == -1).sum() == 10
    variance = reward.variance(pairs["observation"], pairs["action"])
    assert torch.equal(paid.squeeze(-1) == 1, variance <= reward.threshold)
    with pytest.raises(UserError, match=r"^quantile=0 is outside \(0, 1\]"):
        reward.calibrate(pairs, 0)


@pytest.mark.parametrize("kind", SPECS)
def test_cloning_losses_are_the_sum_over_members(kind):
    reward = DisagreementReward.for_vectors(3, SPECS[kind], hidden=[16], normalise="raw")
    pairs = vectors(20, kind=kind)
    outputs, target = reward.outputs(pairs["observation"]), reward.actions.target(pairs["action"])
    if kind == "box":
        expected = sum(F.mse_loss(x, target) for x in outputs)
    else:
        expected = sum(F.cross_entropy(x, target) for x in outputs)
    torch.testing.assert_close(DisagreementLoss(reward)(pairs)["loss_cloning"], expected)
    each = cloning_losses(outputs, target, kind != "box")
    assert each.shape == (5, 20)


def test_members_are_separate_networks():
    ensemble = EnsembleMLP(3, 4, 2, [8])
    x = torch.randn(6, 4)
    for i in range(3):
        first, last = ensemble.layers
        hidden = (x @ first.weight[i] + first.bias[i]).relu()
        torch.testing.assert_close(ensemble(x)[i], hidden @ last.weight[i] + last.bias[i])
    ensemble(x)[1].sum().backward()
    for parameter in ensemble.parameters():
        assert parameter.grad[1].any() and not parameter.grad[[0, 2]].any()


def test_each_member_learns_from_its_own_sample():
    pairs = vectors(30, kind="discrete")
    random = torch.get_rng_state()
    sampled = bootstrapped(pairs, 5, seed=2)
    assert torch.equal(torch.get_rng_state(), random) and "bootstrap" not in pairs
    counts = sampled["bootstrap"]
    assert counts.shape == (30, 5) and (counts.sum(0) == 30).all()
    assert all((counts[:, i] != counts[:, j]).any() for i in range(5) for j in range(i))
    reward = DisagreementReward.for_vectors(3, SPECS["discrete"], hidden=[16], normalise="raw")
    loss = DisagreementLoss(reward, bootstrap=True)
    each = cloning_losses(reward.outputs(pairs["observation"]), pairs["action"], True)
    torch.testing.assert_close(loss(sampled)["loss_cloning"], (each * counts.T).sum(0).mean())
    with pytest.raises(UserError, match="the batch has no 'bootstrap'"):
        loss(pairs)


def test_a_trained_ensemble_agrees_on_the_demonstration_alone():
    torch.manual_seed(0)
    pairs = vectors(60)
    pairs["action"] = pairs["observation"][:, :2].tanh()
    reward = DisagreementReward.for_vectors(3, SPECS["box"], hidden=[32, 32], variance="state")
    reward.scaler.fit(pairs["observation"])
    loss = DisagreementLoss(reward, bootstrap=True)
    totals = train(loss, bootstrapped(pairs, 5, seed=0), 400, 3e-3)
    assert totals[-1] < totals[0] / 20
    reward.calibrate(pairs)
    far = pairs.clone()
    far["observation"] *= 4
    assert reward(pairs)["next", "intrinsic_reward"].mean() > 0.9
    assert reward(far)["next", "intrinsic_reward"].mean() < 0
    assert total(loss(bootstrapped(pairs, 5, seed=0))).isfinite()


def test_saved_and_loaded(tmp_path):
    reward = DisagreementReward.for_vectors(3, SPECS["box"], hidden=[16], normalise="raw")
    pairs = vectors(40)
    reward.calibrate(pairs, 0.5)
    loaded = DisagreementReward.from_pretrained(reward.save_pretrained(tmp_path))
    assert torch.equal(
        loaded(pairs.clone())["next", "intrinsic_reward"],
        reward(pairs.clone())["next", "intrinsic_reward"],
    )
