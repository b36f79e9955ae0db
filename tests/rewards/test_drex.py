import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical

from giril_rl.errors import UserError
from giril_rl.graphs.gradients import TracedGradients
from giril_rl.networks.ensembles import EnsembleMLP
from giril_rl.rewards.drex import DREXReward, PreferenceLoss
from giril_rl.rewards.preferences import preference_loss, snippet_pairs, snippet_rows


def linear(weights, **kwargs):
    """Rewards ``w * s`` of states of one number, one member for each weight."""
    reward = DREXReward.for_vectors(
        1,
        Bounded(-1, 1, shape=(1,)),
        members=len(weights),
        hidden=(),
        normalise="raw",
        clamp=100.0,
        **kwargs,
    )
    with torch.no_grad():
        reward.ensemble.layers[0].weight.copy_(torch.tensor(weights).reshape(-1, 1, 1))
        reward.ensemble.layers[0].bias.zero_()
    return reward


def drawn(noise, lengths, *, pairs=1000, snippet=4, margin=0.3, seed=0):
    return snippet_rows(
        torch.tensor(noise),
        torch.tensor(lengths),
        pairs=pairs,
        snippet=snippet,
        margin=margin,
        generator=torch.Generator().manual_seed(seed),
    )


def test_the_probability_of_a_preference_by_hand():
    # exp(1) / (exp(1) + exp(3)) = 1 / (1 + e^2)
    loss = preference_loss(torch.tensor(1.0), torch.tensor(3.0))
    assert loss.item() == pytest.approx(math.log(1 + math.exp(2)))
    both = torch.tensor([[1.0, 3.0]])
    cross_entropy = torch.nn.functional.cross_entropy(both, torch.tensor([0]))
    torch.testing.assert_close(loss, cross_entropy)
    assert preference_loss(torch.tensor(-1e4), torch.tensor(1e4)).isfinite()


def test_its_gradient_raises_the_better_and_lowers_the_worse():
    better, worse = torch.tensor(1.0, requires_grad=True), torch.tensor(1.0, requires_grad=True)
    preference_loss(better, worse).backward()
    assert (better.grad, worse.grad) == (-0.5, 0.5)


def test_the_less_noisy_one_is_better_by_the_margin():
    noise, lengths = [0.0, 0.25, 0.5, 0.75], [10, 10, 10, 10]
    better, worse = drawn(noise, lengths, margin=0.5)
    level = torch.tensor(noise)
    found = {(b, w) for b, w in zip(better[:, 0] // 10, worse[:, 0] // 10, strict=True)}
    assert {(int(b), int(w)) for b, w in found} == {(0, 2), (0, 3), (1, 3)}
    assert (level[worse // 10] - level[better // 10] >= 0.5).all()


def test_levels_that_differ_by_the_margin_count_whatever_the_rounding():
    noise = (torch.arange(20) / 20).tolist()
    better, worse = drawn(noise, [1] * 20, snippet=1, pairs=20_000)
    gaps = (worse - better).flatten()
    assert gaps.min() == 6  # 0.3 and more.
    assert len(torch.cat([better, worse], 1).unique(dim=0)) == 14 * 15 / 2


def test_snippets_are_consecutive_steps_of_one_episode_from_anywhere():
    better, worse = drawn([0.0, 1.0], [7, 3])
    assert (better.diff(dim=1) == 1).all()
    assert better[:, 0].unique().tolist() == [0, 1, 2, 3]
    counts = better[:, 0].bincount().double() / 1000
    assert (counts - 0.25).abs().max() < 0.06
    assert worse.unique(dim=0).tolist() == [[7, 8, 9, -1]]  # The whole of a shorter one.


def test_levels_too_near_are_refused():
    with pytest.raises(UserError, match=r"^no two noise levels differ by 0\.3: set a smaller"):
        drawn([0.0, 0.2], [5, 5])


def test_pairs_follow_from_the_seed_and_differ_between_members():
    noise, lengths = torch.tensor([0.0, 0.5, 0.9]), torch.tensor([50, 60, 70])
    sizes = {"members": 2, "pairs": 50, "snippet": 5, "margin": 0.3}
    one, rest = snippet_pairs(noise, lengths, seed=1, **sizes)
    again, _ = snippet_pairs(noise, lengths, seed=1, **sizes)
    other, _ = snippet_pairs(noise, lengths, seed=2, **sizes)
    assert (len(one), len(rest)) == (40, 10)
    assert torch.equal(one["better"], again["better"])
    assert not torch.equal(one["better"], other["better"])
    assert not torch.equal(one["better"][:, 0], one["better"][:, 1])


def test_the_loss_by_hand():
    reward = linear([1.0, -2.0])
    played = TensorDict({"observation": torch.tensor([[1.0], [2.0], [4.0]])}, [3])
    batch = TensorDict(
        {
            "better": torch.tensor([[[1, 2], [0, -1]]]),
            "worse": torch.tensor([[[0, 1], [2, -1]]]),
        },
        [1],
    )
    out = PreferenceLoss(reward, played, l2=0.01)(batch)
    # Member 0: sums 6 and 3. Member 1: -2 and -8, for -1 is no step.
    expected = math.log(1 + math.exp(-3)) + math.log(1 + math.exp(-6))
    assert out["loss_preference"].item() == pytest.approx(expected, rel=1e-5)
    assert out["loss_l2"].item() == pytest.approx(0.01 * 5)
    assert out["accuracy"] == 1


def test_members_learn_from_their_own_pairs_alone():
    reward = linear([0.0, 0.0])
    played = TensorDict({"observation": torch.tensor([[1.0], [0.0]])}, [2])
    batch = TensorDict(
        {"better": torch.tensor([[[0], [1]]]), "worse": torch.tensor([[[1], [0]]])}, [1]
    )
    gradients = TracedGradients(PreferenceLoss(reward, played), keys=["better", "worse"])
    gradients(batch)
    # Member 0 prefers the state 1, member 1 the state 0: -d log(1/2) = -1/2 * 1.
    assert reward.ensemble.layers[0].weight.grad.flatten().tolist() == [-0.5, 0.5]


def test_members_separately_compute_what_they_do_together():
    ensemble, inputs = EnsembleMLP(3, 4, 2, (8,)), torch.randn(3, 5, 4)
    together = torch.stack([ensemble(inputs[i])[i] for i in range(3)])
    torch.testing.assert_close(ensemble.separately(inputs), together)


def test_the_reward_is_the_mean_of_standardised_and_clipped_members():
    reward = linear([1.0, 10.0], clip=2.0)
    played = TensorDict({"observation": torch.tensor([[1.0], [3.0]])}, [2])
    reward.calibrate(played)
    assert (reward.mean.tolist(), reward.std.tolist()) == ([2.0, 20.0], [1.0, 10.0])
    batch = TensorDict({"observation": torch.tensor([[2.0], [3.0], [9.0]])}, [3])
    paid = reward(batch)["next", "intrinsic_reward"].flatten()
    assert paid.tolist() == pytest.approx([0.0, 1.0, 2.0])


def test_a_member_that_pays_one_reward_for_all_keeps_its_unit():
    reward = linear([0.0, 1.0])
    reward.calibrate(TensorDict({"observation": torch.tensor([[1.0], [3.0]])}, [2]))
    assert reward.std.tolist() == [1.0, 1.0]
    assert (
        reward(TensorDict({"observation": torch.ones(2, 1)}, [2]))["next", "intrinsic_reward"]
        .isfinite()
        .all()
    )


def test_it_reads_actions_by_choice():
    spec = Categorical(3)
    assert DREXReward.for_vectors(2, spec).in_keys == ["observation"]
    reward = DREXReward.for_vectors(2, spec, use_actions=True, normalise="raw")
    played = TensorDict({"observation": torch.randn(9, 2), "action": torch.arange(9) % 3}, [9])
    reward.calibrate(played)
    rows = torch.arange(9).reshape(1, 3, 3)
    loss = PreferenceLoss(reward, played)(TensorDict({"better": rows, "worse": rows}, [1]))
    assert loss["loss_preference"].item() == pytest.approx(3 * math.log(2), rel=1e-5)
    assert reward(played)["next", "intrinsic_reward"].mean().item() == pytest.approx(0, abs=1e-5)
