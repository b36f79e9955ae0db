import math

import pytest
import torch
import torch.nn.functional as F
from torch import nn

from giril_rl.errors import UserError
from giril_rl.rewards.adversarial import (
    adversarial_reward,
    discriminator_loss,
    dual_step,
    gradient_penalty,
    interpolated,
)

FORMS = ("positive", "negative", "log_ratio", "reversed")


def logit(probability):
    return math.log(probability / (1 - probability))


def test_the_loss_by_hand_with_unequal_sets():
    # D of the expert's: 1/2, 1/4, 4/5; D of the policy's: 1/2, 3/4
    expert = torch.tensor([logit(p) for p in (0.5, 0.25, 0.8)])
    policy = torch.tensor([logit(p) for p in (0.5, 0.75)])
    of_expert, of_policy = discriminator_loss(expert, policy)
    assert of_expert.item() == pytest.approx((math.log(2) + math.log(4) + math.log(1.25)) / 3)
    assert of_policy.item() == pytest.approx((math.log(2) + math.log(4)) / 2)


def test_the_loss_is_cross_entropy_with_the_experts_label_1():
    expert, policy = 3 * torch.randn(7), 3 * torch.randn(5)
    of_expert, of_policy = discriminator_loss(expert, policy)
    expected = F.binary_cross_entropy(torch.sigmoid(expert), torch.ones(7))
    torch.testing.assert_close(of_expert, expected)
    expected = F.binary_cross_entropy(torch.sigmoid(policy), torch.zeros(5))
    torch.testing.assert_close(of_policy, expected)


def test_a_set_said_twice_weighs_the_same():
    expert, policy = torch.randn(6), torch.randn(4)
    once, twice = discriminator_loss(expert, policy), discriminator_loss(expert.repeat(2), policy)
    torch.testing.assert_close(torch.stack(once), torch.stack(twice))


# With D = 4/5: log 5, log 4/5, log 4, log 5/4.
BY_HAND = {"positive": 5.0, "negative": 0.8, "log_ratio": 4.0, "reversed": 1.25}


@pytest.mark.parametrize("form", FORMS)
def test_rewards_by_hand(form):
    found = adversarial_reward(torch.tensor([logit(0.8)]), form)
    assert found.item() == pytest.approx(math.log(BY_HAND[form]), abs=1e-6)
    even = {
        "positive": math.log(2),
        "negative": -math.log(2),
        "log_ratio": 0,
        "reversed": math.log(2),
    }
    assert adversarial_reward(torch.zeros(1), form).item() == pytest.approx(even[form])


def test_rewards_against_probabilities_in_both_conventions():
    z = torch.linspace(-8, 8, 33, dtype=torch.float64)
    ours = torch.sigmoid(z)  # P(expert)
    theirs = 1 - ours  # Ho and Ermon's D, P(policy)
    expected = {
        "positive": (-(1 - ours).log(), -theirs.log()),
        "negative": (ours.log(), (1 - theirs).log()),
        "log_ratio": (ours.log() - (1 - ours).log(), (1 - theirs).log() - theirs.log()),
        "reversed": (-ours.log(), -(1 - theirs).log()),
    }
    for form, formulas in expected.items():
        for formula in formulas:
            torch.testing.assert_close(adversarial_reward(z, form), formula)


def test_which_forms_reward_survival_and_which_likeness():
    z = torch.linspace(-20, 20, 81, dtype=torch.float64)
    rewards = {form: adversarial_reward(z, form) for form in FORMS}
    assert (rewards["positive"] > 0).all() and (rewards["reversed"] > 0).all()
    assert (rewards["negative"] < 0).all()
    assert rewards["log_ratio"].min() < 0 < rewards["log_ratio"].max()
    for form, reward in rewards.items():
        steps = reward.diff()
        assert (steps < 0).all() if form == "reversed" else (steps > 0).all()


@pytest.mark.parametrize("form", FORMS)
def test_no_logit_is_too_large(form):
    z = torch.tensor([-1e4, 1e4], requires_grad=True)
    reward = adversarial_reward(z, form)
    reward.sum().backward()
    expected = {
        "positive": ([0, 1e4], [0, 1]),
        "negative": ([-1e4, 0], [1, 0]),
        "log_ratio": ([-1e4, 1e4], [1, 1]),
        "reversed": ([1e4, 0], [-1, 0]),
    }[form]
    assert (reward.tolist(), z.grad.tolist()) == expected


def test_no_logit_is_too_large_for_the_loss():
    right = torch.tensor([1e4], requires_grad=True)
    wrong = torch.tensor([-1e4], requires_grad=True)
    assert torch.stack(discriminator_loss(right, -right)).tolist() == [0, 0]
    losses = torch.stack(discriminator_loss(wrong, -wrong))
    assert losses.tolist() == [1e4, 1e4]
    losses.sum().backward()
    assert wrong.grad.tolist() == [-2.0]


def test_unknown_form():
    with pytest.raises(UserError, match="form='airl' is unknown"):
        adversarial_reward(torch.zeros(1), "airl")


def test_points_between_sets_by_hand():
    expert = torch.tensor([[0.0, 8.0]])
    policy = torch.tensor([[4.0, 0.0], [0.0, 0.0], [2.0, 2.0]])
    found = interpolated(expert, policy, torch.tensor([0.0, 1.0, 0.25]))
    assert found.tolist() == [[4.0, 0.0], [0.0, 8.0], [1.5, 3.5]]
    swapped = interpolated(policy, expert, torch.tensor([1.0, 0.0, 0.75]))
    assert torch.equal(found, swapped)
    images = interpolated(torch.zeros(2, 3, 4, 4), torch.ones(5, 3, 4, 4), torch.full((5,), 0.25))
    assert torch.equal(images, torch.full((5, 3, 4, 4), 0.75))


def test_penalty_by_hand():
    # The gradient of s1 * s2 + 6 a at (3, 0): (0, 3, 6), of norm the root of 45.
    s, a = torch.tensor([[3.0, 0.0]]), torch.tensor([[1.0]])
    found = gradient_penalty(lambda s, a: s[:, 0] * s[:, 1] + 6 * a[:, 0], [s, a])
    assert found.item() == pytest.approx((math.sqrt(45) - 1) ** 2)


@pytest.mark.parametrize("shape", [(6,), (2, 5, 5)])
def test_penalty_and_its_slope_against_finite_differences(shape):
    torch.manual_seed(0)
    size = math.prod(shape) + 2
    network = nn.Sequential(nn.Linear(size, 8), nn.Tanh(), nn.Linear(8, 1)).double()

    def score(s, a):
        return network(torch.cat((s.flatten(1), a), 1)).squeeze(1)

    points = [torch.randn(4, *shape).double(), torch.randn(4, 2).double()]
    norms, h = [], 1e-6
    for pair in range(4):
        squares = 0.0
        for which, point in enumerate(points):
            for place in range(point[pair].numel()):
                values = []
                for sign in (h, -h):
                    moved = [p[pair : pair + 1].clone() for p in points]
                    moved[which].view(-1)[place] += sign
                    values.append(score(*moved).item())
                squares += ((values[0] - values[1]) / (2 * h)) ** 2
        norms.append(math.sqrt(squares))
    penalty = gradient_penalty(score, points)
    assert penalty.item() == pytest.approx(sum((n - 1) ** 2 for n in norms) / 4, rel=1e-6)
    penalty.backward()
    weight = network[0].weight
    slope, values = weight.grad[0, 0].item(), []
    for sign in (h, -h):
        with torch.no_grad():
            weight[0, 0] += sign
            values.append(gradient_penalty(score, points).item())
            weight[0, 0] -= sign
    assert slope == pytest.approx((values[0] - values[1]) / (2 * h), rel=1e-4)


@pytest.mark.parametrize("shape", [(), (6,), (2, 3), (2, 1, 3)])
def test_penalty_of_any_leading_shape(shape):
    """The gradient is (3 s, 4) at s, and s is 0 or 1: norms of 4 and 5."""
    s = torch.arange(math.prod(shape)).reshape(*shape, 1) % 2.0
    expected = torch.where(s == 0, 9.0, 16.0).mean()
    points = s, torch.zeros(*shape, 1)
    found = gradient_penalty(lambda s, a: (1.5 * s.square() + 4 * a).sum(-1), points)
    torch.testing.assert_close(found, expected)


def test_a_flat_discriminator_has_a_finite_slope():
    network = nn.Linear(3, 1)
    nn.init.zeros_(network.weight)
    penalty = gradient_penalty(lambda s: network(s).squeeze(1), [torch.randn(5, 3)])
    assert penalty.item() == 1.0
    penalty.backward()
    assert network.weight.grad.isfinite().all()


def test_dual_step_by_hand():
    beta, kl = torch.tensor(0.25), torch.tensor([1.5, 0.5, 0.25, 0.0])
    assert dual_step(beta, kl, limit=0.5, step=2.0).tolist() == [2.25, 0.25, 0.0, 0.0]
