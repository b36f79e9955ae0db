"""The shipped tasks: what they are, and that their simulators repeat themselves."""

from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from giril_rl.config.recipes import shipped_conf
from giril_rl.config.schema import TaskConfig
from giril_rl.envs import gym_factory, make_env

# Observation, action, time limit, and whether a failure can end an episode.
TASKS = {
    "inverted_pendulum": (5, 1, 1000, True),
    "inverted_double_pendulum": (9, 1, 1000, True),
    "inverted_pendulum_swingup": (5, 1, 1000, False),
    "half_cheetah": (26, 6, 1000, False),
    "hopper": (15, 3, 1000, True),
    "walker2d": (22, 6, 1000, True),
    "ant": (28, 8, 1000, True),
    "reacher": (9, 2, 150, False),
}


def shipped(name):
    settings = yaml.safe_load((shipped_conf() / "task" / f"{name}.yaml").read_text())
    return TaskConfig(**settings)


def test_every_shipped_task_is_in_this_file():
    files = {path.stem for path in Path(shipped_conf() / "task").glob("*.yaml")}
    games = {
        name for name in files - {"gymnasium", "atari"} if shipped(name).family.name == "atari"
    }
    assert files - games - {"gymnasium", "atari"} == set(TASKS)
    assert len(games) == 6  # Held to theirs in test_atari.py.


@pytest.fixture(params=TASKS)
def name(request):
    return request.param


def episode(env, seed, actions):
    """What an environment shows and pays from ``seed`` on."""
    seen = [env.reset(seed=seed)[0].copy()]
    paid = []
    for action in actions:
        observation, reward, terminated, truncated, _ = env.step(action)
        seen.append(observation.copy())
        paid.append(reward)
        if terminated or truncated:
            break
    return np.stack(seen), np.array(paid)


def test_sizes_and_limits_are_as_said(name):
    task = shipped(name)
    assert task.name == name
    env = gym_factory(task)()
    observation, action, limit, _ = TASKS[name]
    assert env.observation_space.shape == (observation,)
    assert env.action_space.shape == (action,)
    assert (env.action_space.low == -1).all() and (env.action_space.high == 1).all()
    assert env.spec.max_episode_steps == limit
    env.close()


def test_a_used_simulator_repeats_a_fresh_one_rewards_included(name):
    """Some keep a potential, contacts or a saved state of their own across resets."""
    make = gym_factory(shipped(name))
    used, fresh = make(), make()
    rng = np.random.default_rng(0)
    size = TASKS[name][1]
    actions = [rng.uniform(-1, 1, (60, size)).astype(np.float32) for _ in range(3)]
    first = [episode(used, 10 + k, actions[k]) for k in range(3)]
    for k in (2, 0):
        for again in (episode(fresh, 10 + k, actions[k]), episode(used, 10 + k, actions[k])):
            for one, other in zip(again, first[k], strict=True):
                np.testing.assert_array_equal(one, other)
    assert not np.array_equal(first[0][0][0], first[1][0][0])  # The seed decides the start.
    used.close()
    fresh.close()


def test_a_restored_simulator_continues_bit_for_bit(name):
    task = shipped(name)
    env, other = make_env(task, 2, seed=0), make_env(task, 2, seed=9)
    torch.manual_seed(0)
    actions = [env.action_spec.rand() for _ in range(50)]
    root = env.reset()
    for action in actions[:30]:
        _, root = env.step_and_maybe_reset(root.set("action", action))
    other.restore_simulator(env.simulator_state())
    roots = root, other.reset()
    ended = False
    for action in actions[30:]:
        steps = [
            e.step_and_maybe_reset(r.clone().set("action", action))
            for e, r in zip((env, other), roots, strict=True)
        ]
        for key in ("observation", "reward", "done"):
            assert torch.equal(steps[0][0]["next", key], steps[1][0]["next", key]), key
        ended |= bool(steps[0][0]["next", "terminated"].any())
        roots = steps[0][1], steps[1][1]
    assert TASKS[name][3] or not ended
    env.close()
    other.close()


def test_actions_are_stepped_with_as_they_are_executed(name):
    """The walkers and the reacher pay for the action that they are given, not the one they do."""
    task = shipped(name)
    one, other = make_env(task, 1, seed=0), make_env(task, 1, seed=0)
    action = torch.full_like(one.action_spec.rand(), 3.0)
    bound = torch.ones_like(action)
    one.reset(), other.reset()
    for _ in range(5):
        a = one.step(one.reset().set("action", action))["next"]
        b = other.step(other.reset().set("action", bound))["next"]
        assert torch.equal(a["reward"], b["reward"])
        assert torch.equal(a["observation"], b["observation"])
    one.close()
    other.close()
