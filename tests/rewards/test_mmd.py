import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded

from giril_rl.errors import UserError
from giril_rl.rewards import points as points_module
from giril_rl.rewards.mmd import MMDReward, kernel, mean_kernel, squared_mmd
from giril_rl.runs.checkpoint import load_state, save_state
from giril_rl.training import VisitTrainer, own_visits

BOX = Bounded(-1.0, 1.0, shape=(1,))


def k(x, y, bandwidths):
    """The definition for two points."""
    return sum(math.exp(-(torch.dist(x, y).item() ** 2) / b) for b in bandwidths)


def looped(points, atoms, visits, bandwidths):
    return [
        sum(k(x, y, bandwidths) for y in atoms) / len(atoms)
        - sum(k(x, y, bandwidths) for y in visits) / len(visits)
        for x in points
    ]


def transitions(*batch, seed=0):
    generator = torch.Generator().manual_seed(seed)
    s = torch.randn(*batch, 2, generator=generator)
    a = torch.rand(*batch, 1, generator=generator) * 2 - 1
    return TensorDict({"observation": s, "action": a}, batch)


def made(n=20, **kwargs):
    reward = MMDReward.for_vectors(2, BOX, atoms=n, **kwargs)
    reward.remember(transitions(n))
    return reward


def paid(reward, batch):
    return reward(batch.clone())["next", "intrinsic_reward"].squeeze(-1)


def numbered(*batch, start=0):
    """Observations 0, 1, 2 ... in order of time, environments side by side."""
    n, t = batch
    s = start + torch.arange(n * t).reshape(t, n).T.float()
    return TensorDict({"observation": s.unsqueeze(-1)}, batch)


def of_numbers(**kwargs):
    reward = MMDReward.for_vectors(
        1, BOX, atoms=4, use_actions=False, normalise="raw", clamp=None, **kwargs
    )
    reward.remember(TensorDict({"observation": torch.arange(4.0).unsqueeze(-1)}, [4]))
    return reward


def held(reward):
    return reward.visited[reward.weights > 0].flatten().tolist()


def test_kernel_by_hand():
    x, y = torch.tensor([[0.0, 0.0]]), torch.tensor([[3.0, 4.0], [0.0, 0.0]])
    got = kernel(x, y, torch.tensor([25.0, 5.0]))
    torch.testing.assert_close(got, torch.tensor([[math.exp(-1) + math.exp(-5), 2.0]]))


def test_mean_kernel_against_a_loop_in_parts(monkeypatch):
    x, y, b = torch.randn(3, 5, 4), 100 + torch.randn(30, 4), torch.tensor([1.0, 7.0])
    x = x + 100  # Far from the origin, where squares are large.
    whole = mean_kernel(x, y, b)
    by_loop = [sum(k(p, q, b) for q in y) / 30 for p in x.reshape(15, 4)]
    torch.testing.assert_close(whole.flatten(), torch.tensor(by_loop), rtol=1e-4, atol=1e-5)
    monkeypatch.setattr(points_module, "DISTANCES_AT_ONCE", 100)
    torch.testing.assert_close(mean_kernel(x, y, b), whole)


def test_squared_mmd():
    x, y, b = torch.randn(12, 3), torch.randn(9, 3) + 1, torch.tensor([2.0, 5.0])
    assert squared_mmd(x, x, b).abs() < 1e-6
    assert squared_mmd(x, x.flip(0), b).abs() < 1e-6
    mean = [
        sum(k(p, q, b) for p in one for q in two) / (len(one) * len(two))
        for one, two in ((x, x), (y, y), (x, y))
    ]
    expected = mean[0] + mean[1] - 2 * mean[2]
    assert expected > 0.1
    assert squared_mmd(x, y, b).item() == pytest.approx(expected, abs=1e-5)
    # Weights choose a part of the set.
    padded, weights = torch.cat([y, 7 * y]), torch.tensor([1 / 9] * 9 + [0.0] * 9)
    torch.testing.assert_close(squared_mmd(x, padded, b, weights), squared_mmd(x, y, b))


@pytest.mark.parametrize("kept", ["recent", "all"])
def test_reward_against_a_loop(kept):
    reward = made(kept=kept, visits=50, every=1)
    visits, batch = transitions(2, 8, seed=1), transitions(5, seed=2)
    reward.observe(visits)
    points, atoms, own = (
        reward.points(reward.raw(*(x[key] for key in reward.in_keys)))
        for x in (batch, transitions(20), visits.reshape(-1))
    )
    expected = looped(points, atoms, own, reward.bandwidths.tolist())
    torch.testing.assert_close(paid(reward, batch), torch.tensor(expected))
    assert (reward.weights > 0).sum() == 16


def test_all_keeps_each_visit_with_equal_probability():
    counts = torch.zeros(40)
    generator = torch.Generator().manual_seed(0)
    for _ in range(400):
        reward = of_numbers(kept="all", visits=8)
        for start in (0, 10, 20, 30):
            reward.observe(numbered(2, 5, start=start), generator)
        counts[reward.visited.flatten().long()] += 1
    # 400 draws of probability 1/5 each: 80 with a standard deviation of 8.
    assert (counts - 80).abs().max() < 32
    assert counts.sum() == 8 * 400


def test_all_loses_no_visit_while_there_is_room():
    reward = of_numbers(kept="all", visits=16)
    reward.observe(numbered(2, 4))
    reward.observe(numbered(2, 4, start=8))
    assert sorted(held(reward)) == list(range(16))


def test_bandwidths():
    reward = made()
    atoms = reward.points(reward.atoms)
    within = torch.nn.functional.pdist(atoms).median().square()
    torch.testing.assert_close(reward.bandwidths, within.expand(2))
    first = transitions(2, 8, seed=1)
    reward.observe(first)
    points = reward.points(reward.raw(first["observation"], first["action"])).reshape(16, 3)
    between = torch.cdist(points, atoms).median().square()
    torch.testing.assert_close(reward.bandwidths, torch.stack([within, between]))
    reward.observe(transitions(2, 8, seed=2))  # Later visits change it no more.
    torch.testing.assert_close(reward.bandwidths, torch.stack([within, between]))


def test_recent_keeps_the_last_of_all_environments():
    reward = of_numbers(visits=6, every=1)
    reward.observe(numbered(2, 2))
    assert held(reward) == [0, 1, 2, 3]
    reward.observe(numbered(2, 4, start=4))
    assert sorted(held(reward)) == [6, 7, 8, 9, 10, 11]
    reward.observe(numbered(2, 1, start=12))
    assert sorted(held(reward)) == [8, 9, 10, 11, 12, 13]


@pytest.mark.parametrize("size", [1, 2, 5])
def test_one_in_k_whatever_the_batches(size):
    reward = of_numbers(visits=4, every=3)
    for start in range(0, 20, 2 * size):
        reward.observe(numbered(2, size, start=start))
    total = -(-20 // (2 * size)) * 2 * size
    assert sorted(held(reward)) == list(range(0, total, 3))[-4:]


def test_before_any_visit_it_is_the_likeness_alone():
    reward = made()
    batch = transitions(5, seed=2)
    points = reward.points(reward.raw(batch["observation"], batch["action"]))
    atoms = reward.points(reward.atoms)
    torch.testing.assert_close(paid(reward, batch), mean_kernel(points, atoms, reward.bandwidths))


def test_visits_make_a_place_pay_less():
    reward, here, there = made(every=1), transitions(8)[:4], transitions(20)[10:14]
    reward.observe(transitions(1, 4, seed=5))
    before = paid(reward, here) - paid(reward, there)
    reward.observe(here.expand(30, 4))
    assert (paid(reward, here) - paid(reward, there)).mean() < before.mean()


def test_policy_that_matches_the_demonstration_earns_nothing():
    reward = made(every=1)
    reward.observe(transitions(20))
    assert paid(reward, transitions(9, seed=3)).abs().max() < 1e-5
    assert reward.squared_mmd().abs() < 1e-5


@pytest.mark.parametrize("kept", ["recent", "all"])
def test_a_trainer_resumes_bit_for_bit(kept, tmp_path, monkeypatch):
    monkeypatch.setattr(own_visits, "MEASURED_EVERY", 16)

    def trainer():
        return VisitTrainer(made(kept=kept, visits=10, every=2), seed=3)

    whole, first = trainer(), trainer()
    random = torch.get_rng_state()
    for seed in range(6):
        metrics = whole.update(transitions(2, 8, seed=seed))
    assert torch.equal(torch.get_rng_state(), random)
    for seed in range(3):
        first.update(transitions(2, 8, seed=seed))
    save_state(tmp_path / "trainer.safetensors", first.state_dict())
    resumed = trainer()
    resumed.load_state_dict(load_state(tmp_path / "trainer.safetensors"))
    for seed in range(3, 6):
        last = resumed.update(transitions(2, 8, seed=seed))
    assert last == metrics and metrics["mmd/visits"] == 10
    assert torch.equal(resumed.reward.visited, whole.reward.visited)
    batch = transitions(5, seed=9)
    assert torch.equal(paid(resumed.reward, batch), paid(whole.reward, batch))


def test_the_mmd_is_measured_now_and_then():
    trainer = VisitTrainer(made(every=1), seed=0)
    measured = [bool(trainer.update(transitions(2, 100, seed=i))) for i in range(11)]
    assert measured == [i in (0, 4, 9) for i in range(11)]


def test_memory_stays_bounded():
    reward = made(visits=10, every=1)
    for seed in range(5):
        reward.observe(transitions(4, 50, seed=seed))
    assert reward.visited.shape == (10, 3) and reward.seen == 1000


def test_refusals():
    with pytest.raises(UserError, match="kept='last' is unknown: choose recent or all"):
        made(kept="last")
    with pytest.raises(UserError, match="the batch has no 'action'"):
        made().observe(transitions(2, 3).exclude("action"))
