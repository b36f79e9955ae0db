import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from walks import SPEC, demonstration, pwil, rewards, walk

from giril_rl.config.schema import TaskConfig
from giril_rl.envs import make_env
from giril_rl.errors import UserError
from giril_rl.rewards.pwil import PWILConfig, pwil_reward


def loop(vectors, done, points, horizon, alpha=5.0, beta=5.0):
    """PWIL's algorithm 1, one environment, step and atom at a time, of fractions of the weight."""
    size, paid = points.shape[1], []
    weight, steps = np.full(len(points), 1 / len(points)), 0
    for x, over in zip(vectors, done, strict=True):
        distance = np.linalg.norm(points - x, axis=1)
        missing, cost = 1 / horizon, 0.0
        for j in np.argsort(distance):
            taken = min(missing, weight[j])
            weight[j] -= taken
            missing -= taken
            cost += taken * distance[j]
        steps += 1
        value = alpha * math.exp(-beta * horizon / math.sqrt(size) * cost)
        paid.append(value if steps <= horizon else 0.0)
        if over:
            weight, steps = np.full(len(points), 1 / len(points)), 0
    return paid


@pytest.mark.parametrize("length", [30, 12, 8, 5, 1, 29])
def test_against_a_loop(length):
    reward, batch = pwil(demonstration(length), horizon=12), walk(3, 60, ends=0.05)
    assert batch["next", "done"].sum() > 3
    vectors = reward.atoms(batch["observation"], batch["action"]).numpy()
    points, done = reward.atoms.points.numpy(), batch["next", "done"].squeeze(-1).numpy()
    expected = [loop(x, over, points, 12) for x, over in zip(vectors, done, strict=True)]
    torch.testing.assert_close(rewards(reward, batch), torch.tensor(expected), rtol=1e-4, atol=1e-6)
    assert (np.array(expected) == 0).any() and (np.array(expected) > 0.01).any()


@pytest.mark.parametrize("copies", [1, 3])
def test_the_demonstration_itself_costs_nothing(copies):
    demo = demonstration(40)
    reward = pwil(torch.cat([demo] * copies), horizon=40, alpha=2.5)
    assert torch.equal(rewards(reward, demo.unsqueeze(0)), torch.full((1, 40), 2.5))
    shuffled = demo[torch.randperm(40)].clone()  # In another order, made a trajectory of its own.
    shuffled["next", "observation"] = shuffled["observation"].roll(-1, 0)
    assert torch.equal(rewards(reward, shuffled.unsqueeze(0)), torch.full((1, 40), 2.5))


def states(*values):
    """One environment at these states of one number, which goes on to the next."""
    s = torch.tensor(values).unsqueeze(-1)
    done = torch.zeros(len(s) - 1, 1, dtype=torch.bool)
    entries = {"observation": s[:-1], "next": {"observation": s[1:], "done": done}}
    return TensorDict(entries, [len(s) - 1]).unsqueeze(0)


def test_numbers_by_hand():
    """Atoms 0 and 2, whose standard deviation is 1, so that one of 1.001 divides; T = 4, d = 1.

    Each atom fills two steps. 2 is nearest to 3 and 2.5, and used up; then 0 is left for 3 and 0.
    """
    reward = pwil(states(0.0, 2.0, 0.0)[0], horizon=4, spec=None, alpha=1.0, beta=1.0)
    costs = torch.tensor([1.0, 0.5, 3.0, 0.0]) / 1.001 / 4
    paid = rewards(reward, states(3.0, 2.5, 3.0, 0.0, 7.0, 0.0))
    torch.testing.assert_close(paid[0], torch.cat([(-4 * costs).exp(), torch.zeros(1)]))


def test_a_step_is_filled_from_as_many_atoms_as_it_takes():
    """Three atoms and T = 2: a step takes 1.5 atoms, the nearest whole and half the second."""
    reward = pwil(states(0.0, 1.0, 3.0, 0.0)[0], horizon=2, spec=None, alpha=1.0, beta=1.0)
    scale = 1 / (math.sqrt(14 / 9) + 1e-3)
    paid = rewards(reward, states(0.0, 0.0, 0.0))
    costs = torch.tensor([(0 + 0.5 * 1) / 3, (0.5 * 1 + 3) / 3]) * scale
    torch.testing.assert_close(paid[0], (-2 * costs).exp())


def test_a_constant_dimension_keeps_its_unit():
    demo = demonstration(20)
    demo["observation"][:, 1] = 7.0
    batch = demo.clone()
    batch["observation"][:, 1] = batch["next", "observation"][:, 1] = 8.0
    batch["next", "observation"][:-1] = batch["observation"][1:]
    paid = rewards(pwil(demo, horizon=20, beta=1.0), batch.unsqueeze(0))
    torch.testing.assert_close(paid, torch.full((1, 20), 5 * math.exp(-1 / math.sqrt(3))))


def test_without_actions_only_states_count():
    demo, batch = demonstration(20), walk(2, 15)
    other = batch.clone()
    other["action"] = -other["action"]
    reward = pwil(demo.exclude("action"), horizon=20, spec=None)
    assert "action" not in reward.in_keys
    assert torch.equal(rewards(reward, batch), rewards(reward, other))
    reward = pwil(demo, horizon=20)
    assert not torch.equal(rewards(reward, batch), rewards(reward, other))


# The builder


def task(**kwargs):
    return TaskConfig(name="cartpole", env_id="CartPole-v1", **kwargs)


def pairs(number=9):
    action = torch.zeros(number, dtype=torch.int64)
    return TensorDict({"observation": torch.randn(number, 4), "action": action}, [number])


@pytest.mark.parametrize(
    ("entries", "horizon"),
    [({}, 500), ({"max_episode_steps": 40}, 40), ({"horizon": "fixed"}, 500)],
)
def test_the_horizon_is_the_tasks_time_limit(entries, horizon):
    env = make_env(task(**entries), 2, seed=0)
    assert env.time_limit == horizon
    assert pwil_reward(PWILConfig(), env, pairs()).horizon == horizon
    assert pwil_reward(PWILConfig(horizon=7), env, pairs()).horizon == 7


def test_no_time_limit_no_actions_and_images_are_refused():
    env = make_env(task(), 2, seed=0)
    env._limit = None
    with pytest.raises(UserError, match=r"no time limit: set reward\.horizon\.$"):
        pwil_reward(PWILConfig(), env, pairs())
    with pytest.raises(
        UserError, match=r"demonstration has none: set reward\.use_actions=false\.$"
    ):
        pwil_reward(PWILConfig(horizon=5), env, pairs().exclude("action"))
    reward = pwil_reward(PWILConfig(horizon=5, use_actions=False), env, pairs().exclude("action"))
    assert reward.atoms.points.shape == (9, 4)
    with pytest.raises(
        UserError, match=r"^the demonstration's observation is nan at index \[1, 0\]"
    ):
        wrong = pairs()
        wrong["observation"][1, 0] = torch.nan
        pwil_reward(PWILConfig(horizon=5), env, wrong)


def test_used_before_it_has_seen_a_demonstration():
    reward = pwil(demonstration(5), horizon=5)
    fresh = type(reward)(2, SPEC, atoms=5, horizon=5)
    with pytest.raises(UserError, match=r"has not seen a demonstration: call reward\.fit"):
        fresh(walk(1, 3))
    with pytest.raises(
        UserError, match=r"made for a demonstration of 5 transitions, not for \(6,\)"
    ):
        fresh.fit(demonstration(6))


def test_a_large_batch_is_cut_to_bound_the_memory(monkeypatch):
    demo, batch = demonstration(30), walk(3, 50)
    whole = rewards(pwil(demo, horizon=20), batch)
    monkeypatch.setattr("giril_rl.rewards.pwil.AT_ONCE", 3 * 30 * 7)
    assert torch.equal(rewards(pwil(demo, horizon=20), batch), whole)
