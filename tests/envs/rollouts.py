"""Rollouts of random actions, step by step as a collector takes them."""

import numpy as np
import torch

from giril_rl.envs import GymVectorEnv
from giril_rl.runs.checkpoint import load_state, save_state

AFTER = ("observation", "reward", "done", "terminated", "truncated")
KEYS = ["observation", "action", *(("next", name) for name in AFTER)]
BULLET = "InvertedPendulumBulletEnv-v0"


def random_actions(env, steps, seed=0):
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return torch.stack([env.action_spec.rand() for _ in range(steps)])


def play(env, actions, root=None, keys=KEYS, step=GymVectorEnv.step_and_maybe_reset):
    """All transitions ``[N, T]`` and the root that would come next."""
    root = env.reset() if root is None else root
    steps = []
    for action in actions:
        transition, root = step(env, root.clone().set("action", action))
        steps.append(transition.select(*keys).clone())
    return torch.stack(steps, 1), root


def continued(env, fresh, before, path, keys=KEYS):
    """Transitions after ``before`` steps, which ``fresh``, restored from a file, repeats.

    The state is saved once more before any step, as at a second interruption.
    """
    actions = random_actions(env, before + 40)
    root = env.reset()
    for action in actions[:before]:
        _, root = env.step_and_maybe_reset(root.set("action", action))
    save_state(path, env.simulator_state())
    whole, end = play(env, actions[before:], root, keys)
    state = load_state(path)
    assert fresh.restore_simulator(state)
    again = fresh.simulator_state()
    for key in set(state) - {"actions"}:
        assert np.array_equal(again[key], state[key]), key
    found, fresh_end = play(fresh, actions[before:], fresh.reset(), keys)
    for key in keys:
        assert torch.equal(whole[key], found[key]), key
    assert torch.equal(end["observation"], fresh_end["observation"])
    assert whole["next", "done"].any()
    return whole
