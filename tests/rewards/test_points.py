"""Transitions as points, and the nearest neighbour's reward made of them."""

import math

import pytest
import torch
from reward_data import frames
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, OneHot

from giril_rl.errors import UserError
from giril_rl.rewards import points as module
from giril_rl.rewards.nearest import NearestReward, nearest_distance, nearest_reward
from giril_rl.rewards.points import median_distance
from giril_rl.runs.pretrained import Pretrained

BOX = Bounded(-2.0, 2.0, shape=(1,))


def pairs(s, a=None, s_next=None):
    entries = {"observation": torch.as_tensor(s)}
    if a is not None:
        entries["action"] = torch.as_tensor(a)
    if s_next is not None:
        entries["next"] = {"observation": torch.as_tensor(s_next)}
    return TensorDict(entries, [len(entries["observation"])])


def made(demonstration, spec=BOX, **kwargs):
    size = demonstration["observation"].shape[-1]
    reward = NearestReward.for_vectors(size, spec, atoms=len(demonstration), **kwargs)
    reward.remember(demonstration)
    return reward


def paid(reward, batch):
    return reward(batch.clone())["next", "intrinsic_reward"].squeeze(-1)


def loop(points, atoms):
    return torch.stack([torch.stack([torch.dist(x, y) for y in atoms]).min() for x in points])


def test_nearest_distance_against_a_loop_in_parts(monkeypatch):
    points, atoms = torch.randn(3, 7, 4), torch.randn(50, 4)
    whole = nearest_distance(points, atoms)
    torch.testing.assert_close(whole.flatten(), loop(points.reshape(21, 4), atoms))
    monkeypatch.setattr(module, "DISTANCES_AT_ONCE", 120)
    torch.testing.assert_close(nearest_distance(points, atoms), whole, rtol=0, atol=0)


def test_an_atom_is_at_distance_zero():
    atoms = 100 + torch.randn(500, 20)  # Far from the origin, where matrix products lose digits.
    assert not nearest_distance(atoms, atoms).any()


def test_rewards_of_a_distance_by_hand():
    d = torch.tensor([0.0, 1.0, 3.0])
    assert nearest_reward(d, "quadratic").tolist() == [1.0, 0.0, -8.0]
    by_hand = [1.0, math.exp(-1 / 8), math.exp(-9 / 8)]
    assert nearest_reward(d, "gaussian", 2.0).tolist() == pytest.approx(by_hand)
    with pytest.raises(UserError, match="kernel='cubic' is unknown"):
        nearest_reward(d, "cubic")
    with pytest.raises(UserError, match="kernel='cubic' is unknown"):
        NearestReward.for_vectors(2, BOX, atoms=1, kernel="cubic")


def test_raw_units_are_those_of_the_published_code():
    # Two numbers of state and one action, which is within bounds of plus and minus 1.
    spec = Bounded(-1.0, 1.0, shape=(1,))
    reward = made(pairs([[0.0, 0.0], [9.0, 9.0]], [[0.5], [-1.0]]), spec, normalise="raw")
    assert paid(reward, pairs([[1.0, 2.0]], [[0.0]])).item() == pytest.approx(1 - (1 + 4 + 0.25))


def test_standardised_distances_are_root_mean_squares():
    # Standard deviations 1 and 10 of the states, 0.5 of the encoded actions.
    reward = made(pairs([[0.0, 0.0], [2.0, 20.0]], [[-1.0], [1.0]]))
    # From the first: 1, 0 and 2 deviations.
    assert paid(reward, pairs([[1.0, 0.0]], [[1.0]])).item() == pytest.approx(1 - 5 / 3)


def test_a_number_that_the_demonstration_keeps_constant_keeps_its_unit():
    reward = made(pairs([[0.0, 7.0], [2.0, 7.0]]), use_actions=False)
    assert paid(reward, pairs([[0.0, 8.0]])).item() == pytest.approx(0.5)
    reward = made(pairs([[0.0], [2.0]], [[2.0], [2.0]]))
    assert paid(reward, pairs([[0.0]], [[1.0]])).item() == pytest.approx(1 - 0.25 / 2)


@pytest.mark.parametrize("one_hot", [False, True])
def test_two_discrete_actions_are_two_apart_and_count_as_one_dimension(one_hot):
    code = [[1, 0, 0], [0, 1, 0], [0, 0, 1]] if one_hot else [0, 1, 2]
    spec = OneHot(3) if one_hot else Categorical(3)
    reward = made(pairs([[0.0], [2.0]], [code[0], code[0]]), spec)
    got = paid(reward, pairs([[0.0], [0.0], [1.0]], [code[0], code[2], code[1]]))
    assert got.tolist() == pytest.approx([1.0, 1 - 2 / 2, 1 - 3 / 2], abs=1e-6)


def test_states_and_next_states_without_actions():
    demonstration = pairs([[0.0], [2.0]], s_next=[[2.0], [4.0]])
    reward = made(demonstration, use_actions=False, use_next=True)
    assert reward.in_keys == ["observation", ("next", "observation")]
    # Both are scaled by the states' deviation, 1.
    other = pairs([[0.0]], s_next=[[3.0]])
    assert paid(reward, other).item() == pytest.approx(0.5)
    reward = made(demonstration, use_actions=False)
    assert reward.in_keys == ["observation"]
    assert paid(reward, other).item() == 1.0


def test_far_states_are_clamped_or_not():
    near = pairs([[-1.0], [1.0]])
    far = pairs([[100.0]])
    assert paid(made(near, use_actions=False), far).item() == pytest.approx(1 - 81)
    assert paid(made(near, use_actions=False, clamp=None), far).item() == pytest.approx(1 - 99**2)


def test_the_gaussian_has_the_median_of_the_demonstration():
    demonstration = pairs([[0.0], [1.0], [4.0]])
    reward = made(demonstration, use_actions=False, normalise="raw", kernel="gaussian")
    assert reward.length == 3
    assert paid(reward, pairs([[7.0]])).item() == pytest.approx(math.exp(-0.5))


def test_median_distance(monkeypatch):
    x = torch.randn(30, 3)
    by_pairs = [torch.dist(x[i], x[j]) for i in range(30) for j in range(i)]
    torch.testing.assert_close(median_distance(x), torch.stack(by_pairs).median())
    monkeypatch.setattr(module, "MOST_PAIRED", 10)
    torch.testing.assert_close(median_distance(x), median_distance(x[::3]))
    torch.testing.assert_close(median_distance(x, 2 * x), torch.cdist(x[::3], 2 * x[::3]).median())
    for nothing in (x[:1], x[:1].expand(5, 3)):
        assert median_distance(nothing) == 1


def test_saved_and_loaded_with_its_demonstration(tmp_path):
    demonstration = pairs(torch.randn(20, 2), torch.rand(20, 1))
    reward = made(demonstration, kernel="gaussian", use_actions=True)
    loaded = NearestReward.from_pretrained(reward.save_pretrained(tmp_path))
    assert isinstance(loaded, Pretrained) and loaded.kernel == "gaussian"
    batch = pairs(torch.randn(9, 2), torch.rand(9, 1))
    assert torch.equal(paid(loaded, batch), paid(reward, batch))


def test_frames_are_compared_by_fixed_random_features():
    demonstration, batch = frames(6), frames(5, seed=1)
    reward = NearestReward.for_pixels(Categorical(4), atoms=6, seed=3).train()
    reward.remember(demonstration)
    assert torch.equal(paid(reward, demonstration), torch.ones(6))
    assert (paid(reward, batch) < 1).all()
    assert torch.equal(paid(reward.train(), batch), paid(reward.eval(), batch))
    # Another action at the same state is as far as in a vector task of as many numbers.
    other = demonstration.clone()
    other["action"] = (other["action"] + 1) % 4
    assert paid(reward, other)[0].item() == pytest.approx(1 - 2 / 1025, abs=1e-6)


def test_refusals():
    reward = NearestReward.for_vectors(2, BOX, atoms=3)
    batch = pairs(torch.zeros(3, 2), torch.zeros(3, 1))
    with pytest.raises(UserError, match=r"2 demonstrated transitions .* make it with atoms=2"):
        reward.remember(batch[:2])
    bad = batch.clone()
    bad["action"][1] = float("nan")
    with pytest.raises(UserError, match=r"demonstration's action is nan at index \[1, 0\]"):
        reward.remember(bad)
    with pytest.raises(UserError, match="the batch has no 'action'"):
        reward.remember(batch.exclude("action"))
    fresh = NearestReward.for_vectors(2, BOX, atoms=3, normalise="raw")
    with pytest.raises(UserError, match="has no demonstration yet"):
        fresh(batch)
