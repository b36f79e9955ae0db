import math

import pytest
import torch
from tensordict import TensorDict

from giril_rl.errors import UserError
from giril_rl.rewards import entropy_bonus as module
from giril_rl.rewards.entropy_bonus import EntropyBonus, knn_bonus


def loop(states, k):
    """The definition, one state at a time."""
    bonuses = []
    for i, state in enumerate(states):
        others = [torch.dist(state, other) for j, other in enumerate(states) if j != i]
        nearest = torch.stack(others).sort().values[:k]
        bonuses.append(torch.log(1 + nearest.mean()))
    return torch.stack(bonuses)


def test_numbers_by_hand():
    states = torch.tensor([[0.0, 0.0], [3.0, 4.0], [3.0, 4.0], [0.0, 12.0]])
    # To the one nearest: 5, 0, 0 and the distance from (0, 12) to (3, 4), the root of 73.
    expected = [math.log(6), 0.0, 0.0, math.log(1 + math.sqrt(73))]
    assert knn_bonus(states, 1).tolist() == pytest.approx(expected)


@pytest.mark.parametrize("k", [1, 3, 12])
def test_against_a_loop_in_parts(k, monkeypatch):
    states = 3 * torch.randn(40, 5)
    whole = knn_bonus(states, k)
    torch.testing.assert_close(whole, loop(states, k))
    monkeypatch.setattr(module, "DISTANCES_AT_ONCE", 7 * 40)
    torch.testing.assert_close(knn_bonus(states, k), whole, rtol=0, atol=0)


def test_few_states_take_all_others():
    states = torch.randn(5, 2)
    torch.testing.assert_close(knn_bonus(states, 12), loop(states, 4))
    assert knn_bonus(states[:1], 12).tolist() == [0.0]
    assert knn_bonus(states[:0], 12).shape == (0,)


def test_wrong_arguments_are_refused():
    with pytest.raises(UserError, match=r"^k=0 and states of shape \(3, 2\)"):
        knn_bonus(torch.zeros(3, 2), 0)
    with pytest.raises(UserError, match=r"states of shape \(3,\)"):
        knn_bonus(torch.zeros(3), 1)


def of_states(states):
    batch = states.shape[: states.ndim - (3 if states.dtype == torch.uint8 else 1)]
    return TensorDict({"next": {"observation": states}}, batch)


def bonus(reward, states):
    return reward(of_states(states))["next", "intrinsic_reward"]


def test_all_transitions_of_a_call_are_one_batch():
    reward = EntropyBonus.for_vectors(3, k=4)
    reward.scaler.fit(2 * torch.randn(50, 3) + 1)
    states = torch.randn(4, 6, 3)
    whole = bonus(reward, states)
    torch.testing.assert_close(
        whole.squeeze(-1).flatten(), knn_bonus(reward.scaler(states.reshape(24, 3)), 4)
    )
    torch.testing.assert_close(bonus(reward, states.reshape(24, 3)), whole.reshape(24, 1))
    order = torch.tensor([2, 0, 3, 1])
    torch.testing.assert_close(bonus(reward, states[order]), whole[order])


def test_a_large_batch_is_compared_in_parts():
    reward = EntropyBonus.for_vectors(2, k=3, among=10, normalise="raw")
    states = torch.randn(25, 2)
    paid = bonus(reward, states).squeeze(-1)
    for i in range(3):
        torch.testing.assert_close(paid[i::3], knn_bonus(states[i::3], 3))
    # Of as many as `among`, it is the whole batch's.
    torch.testing.assert_close(bonus(reward, states[:10]).squeeze(-1), knn_bonus(states[:10], 3))


def test_it_grows_with_the_spread():
    states = torch.randn(60, 3)
    assert (knn_bonus(3 * states, 5) > knn_bonus(states, 5)).all()


def test_random_features_of_frames_stay_as_they_are(monkeypatch):
    reward = EntropyBonus.for_pixels(channels=2, k=2, seed=3).train()
    before = {k: v.clone() for k, v in reward.state_dict().items()}
    frames = torch.randint(256, (5, 2, 84, 84), dtype=torch.uint8)
    paid = bonus(reward, frames)
    monkeypatch.setattr(module, "PIXELS_AT_ONCE", 2)
    torch.testing.assert_close(bonus(reward, frames), paid)
    assert (paid > 0).all() and not any(p.requires_grad for p in reward.parameters())
    assert all(torch.equal(v, before[k]) for k, v in reward.state_dict().items())
    same = EntropyBonus.for_pixels(channels=2, k=2, seed=3)
    assert torch.equal(bonus(same, frames), bonus(reward, frames))


def test_missing_entry():
    with pytest.raises(UserError, match=r"the batch has no \('next', 'observation'\)"):
        EntropyBonus.for_vectors(3)(TensorDict(batch_size=[4]))
