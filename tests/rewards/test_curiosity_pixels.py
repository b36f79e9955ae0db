"""CDIL's reward and loss of frames against the equations written out."""

import pytest
import torch
import torch.nn.functional as F
from pixel_data import ACTIONS, convolved, run_in, scaled, transitions
from torchrl.data import Categorical

from giril_rl.rewards import CuriosityReward, CuriosityRewardLoss, chunks


def model(**kwargs):
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
    phi, following = (
        convolved(body, scaled(data[key])) for key in ("observation", ("next", "observation"))
    )
    guess = two_layers(reward.inverse_model, phi, following)
    inverse = F.cross_entropy(guess, data["action"], reduction="none")
    code = F.one_hot(data["action"], ACTIONS).float()
    error = F.mse_loss(two_layers(reward.forward_model, phi, code), following, reduction="none")
    return inverse, error.sum(-1)


def test_losses_and_reward_by_hand_in_eval_mode():
    reward, data = model(scale=0.3, seed=1), transitions(6)
    loss = run_in(CuriosityRewardLoss(reward, reduction="none"), data)
    inverse, error = by_hand(reward, data)
    with torch.no_grad():
        out = loss(data)
        paid = reward(data.clone())["next", "intrinsic_reward"]
    torch.testing.assert_close(out["loss_inverse"], inverse, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(out["loss_forward"], error, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(paid, 0.3 * error.unsqueeze(-1), rtol=1e-4, atol=1e-4)


def test_in_eval_mode_only_the_statistics_count_and_in_training_the_batch():
    reward, data = model(), transitions(6)
    run_in(CuriosityRewardLoss(reward), data)
    paid = {}
    with torch.no_grad():
        for mode in (False, True):
            reward.train(mode)
            paid[mode] = [reward(data[:n].clone())["next", "intrinsic_reward"] for n in (6, 3)]
    torch.testing.assert_close(paid[False][0][:3], paid[False][1], rtol=1e-5, atol=1e-6)
    assert not torch.isclose(paid[True][0][:3], paid[True][1], rtol=1e-2).any()


def test_many_transitions_are_taken_some_at_a_time(monkeypatch):
    reward, data = model().eval(), transitions(2, 3)
    with torch.no_grad():
        whole = reward(data.clone())["next", "intrinsic_reward"]
        monkeypatch.setattr(chunks, "PIXELS_AT_ONCE", 4)
        sizes = []
        reward.features.register_forward_hook(lambda _, inputs, out: sizes.append(len(out)))
        parts = reward(data.clone())["next", "intrinsic_reward"]
    assert sizes == [4, 4, 2, 2]
    torch.testing.assert_close(parts, whole, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("features", ["inverse", "both", "none"])
def test_the_losses_fall_within_a_few_steps(features):
    loss, data = CuriosityRewardLoss(model(), features=features), transitions(8)
    frozen = loss.reward.features.body[0].weight.clone()
    optimiser = torch.optim.Adam(loss.parameters(), lr=1e-3)
    totals = []
    for _ in range(8):
        optimiser.zero_grad()
        total = sum(loss(data).values())
        total.backward()
        optimiser.step()
        totals.append(total.item())
    assert totals[-1] < 0.8 * totals[0]
    moved = not torch.equal(loss.reward.features.body[0].weight, frozen)
    assert moved == (features != "none")
