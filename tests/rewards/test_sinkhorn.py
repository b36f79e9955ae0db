import math

import numpy as np
import pytest
import torch
from walks import demonstration, rewards, sinkhorn, walk

from giril_rl.errors import UserError
from giril_rl.rewards.sinkhorn import pairwise_cost, sinkhorn_plan, sinkhorn_value


def random_cost(rows, columns, seed=0, kind="euclidean"):
    generator = torch.Generator().manual_seed(seed)
    x, y = (
        torch.randn(number, 4, generator=generator, dtype=torch.float64) + 0.3
        for number in (rows, columns)
    )
    return pairwise_cost(x, y, kind)


@pytest.mark.parametrize("kind", ["euclidean", "cosine"])
@pytest.mark.parametrize(("rows", "columns"), [(30, 30), (40, 17), (5, 60), (1, 9), (9, 1)])
@pytest.mark.parametrize("iterations", [1, 7, 100])
def test_the_plan_against_pot(rows, columns, kind, iterations):
    ot = pytest.importorskip("ot")
    cost = random_cost(rows, columns, kind=kind)
    weights = [np.full(number, 1 / number) for number in (rows, columns)]
    # A negative threshold: POT does all iterations.
    options = {"numItermax": iterations, "stopThr": -1.0, "warn": False}
    expected = ot.sinkhorn(*weights, cost.numpy(), reg=0.05 * cost.mean().item(), **options)
    plan = sinkhorn_plan(cost, 0.05 * cost.mean().item(), iterations)
    np.testing.assert_allclose(plan.numpy(), expected, rtol=1e-8, atol=1e-12)


def test_a_small_regularisation_does_not_underflow():
    ot = pytest.importorskip("ot")
    cost, weights = random_cost(25, 25), np.full(25, 1 / 25)
    options = {"numItermax": 300, "stopThr": -1.0, "warn": False, "method": "sinkhorn_log"}
    expected = ot.sinkhorn(weights, weights, cost.numpy(), reg=1e-4, **options)
    assert not np.exp(-cost.numpy() / 1e-4).any()  # The kernel itself has nothing left.
    plan = sinkhorn_plan(cost, 1e-4, 300)
    np.testing.assert_allclose(plan.numpy(), expected, rtol=1e-6, atol=1e-12)


def test_marginals_and_the_exact_optimum():
    cost = random_cost(12, 18)
    plan = sinkhorn_plan(cost, 0.05, 2000)
    torch.testing.assert_close(plan.sum(1), torch.full_like(plan[:, 0], 1 / 12))
    torch.testing.assert_close(plan.sum(0), torch.full_like(plan[0], 1 / 18), rtol=1e-4, atol=0)
    ot = pytest.importorskip("ot")
    least = ot.emd2(np.full(12, 1 / 12), np.full(18, 1 / 18), cost.numpy())
    value = -sinkhorn_value(cost, 0.001, 3000).sum().item()
    assert value == pytest.approx(least, rel=0.01)


def test_rows_are_exact_however_few_steps():
    plan = sinkhorn_plan(random_cost(12, 18), 1e-3, 3)
    torch.testing.assert_close(plan.sum(1), torch.full_like(plan[:, 0], 1 / 12))


def test_numbers_by_hand():
    """Costs 0 and 1: by symmetry the plan is in proportion to the kernel, 1 and exp(-1 / eps)."""
    cost = torch.tensor([[0.0, 1.0], [1.0, 0.0]], dtype=torch.float64)
    b = math.exp(-1 / (0.5 * 0.5))  # The regularisation is in units of the mean cost.
    value = sinkhorn_value(cost, 0.5, 100)
    torch.testing.assert_close(value, torch.full_like(value, -b / (2 + 2 * b)))


def test_units_do_not_matter():
    cost = random_cost(20, 15)
    torch.testing.assert_close(sinkhorn_value(1000 * cost), 1000 * sinkhorn_value(cost))


def test_the_demonstration_costs_least_and_a_far_episode_most():
    demo = demonstration(30)
    reward = sinkhorn(demo, scale=1.0)
    far = demo.clone()
    for key in ("observation", ("next", "observation")):
        far[key] = far[key] + 50
    with reward.fresh_episodes():
        same, other, worst = (
            rewards(reward, episode.unsqueeze(0)).sum().item()
            for episode in (demo, demonstration(30, seed=5), far)
        )
    assert 0 >= same > -1e-3 and same > other > worst


def test_the_last_step_is_paid_the_sum_of_all_shares():
    demo, batch = demonstration(9), walk(3, 40)
    running, apart = sinkhorn(demo, scale=3.0), sinkhorn(demo, scale=3.0)
    paid, done = rewards(running, batch), batch["next", "done"].squeeze(-1)
    assert torch.equal(paid != 0, done)
    with apart.fresh_episodes():
        shares = rewards(apart, batch)
    assert (shares < 0).all()
    for i in range(3):
        begin = 0
        for end in done[i].nonzero().flatten().tolist():
            torch.testing.assert_close(shares[i, begin : end + 1].sum(), paid[i, end])
            begin = end + 1


def test_the_scale_is_learned_from_the_first_episode():
    demo, episodes = demonstration(9), [demonstration(n, n).unsqueeze(0) for n in (6, 8, 7)]
    unscaled = sinkhorn(demo, scale=1.0)
    sums = [rewards(unscaled, episode).sum().item() for episode in episodes]
    reward = sinkhorn(demo, first_return=10.0)
    with (
        reward.fresh_episodes(),
        pytest.raises(UserError, match=r"none has ended: .*reward\.scale"),
    ):
        rewards(reward, demo.unsqueeze(0))
    got = [rewards(reward, episode).sum().item() for episode in episodes]
    assert got == pytest.approx([-10 * value / sums[0] for value in sums], rel=1e-5)
    assert got[0] == pytest.approx(-10)
    # The learner's own whole episodes.
    reward = sinkhorn(demo)
    with reward.fresh_episodes(learn=True):
        got = [rewards(reward, episode).sum().item() for episode in episodes]
    assert got == pytest.approx([-10 * value / sums[0] for value in sums], rel=1e-5)


def test_cosine_and_actions():
    demo, batch = demonstration(9), walk(2, 30)
    kinds = {"euclidean": {}, "cosine": {"cost": "cosine"}, "states": {"spec": None}}
    paid = {name: rewards(sinkhorn(demo, scale=1.0, **kind), batch) for name, kind in kinds.items()}
    assert not torch.equal(paid["euclidean"], paid["cosine"])
    assert not torch.equal(paid["euclidean"], paid["states"])
    x = torch.tensor([[0.0, 0.0], [1.0, 0.0]])
    assert pairwise_cost(x, x, "cosine").tolist() == [[1, 1], [1, 0]]
