from dataclasses import replace
from functools import partial

import gymnasium
import numpy as np
import pytest
import rollouts
import torch
from rollouts import BULLET, random_actions
from torchrl.collectors import Collector
from torchrl.envs.utils import check_env_specs

from giril_rl.config.schema import TaskConfig
from giril_rl.envs import FixedHorizonEnv, GymVectorEnv, make_env, with_own_episodes
from giril_rl.errors import UserError
from giril_rl.runs.randomness import stream_seed

KEYS = [*rollouts.KEYS, ("next", "following_observation"), ("next", "scored")]
play = partial(rollouts.play, keys=KEYS)
# CartPole warns of the steps that these tests mean to take.
pytestmark = pytest.mark.filterwarnings("ignore:.*already returned terminated = True")


def task(env_id, limit=None, **kwargs):
    kwargs = {"horizon": "fixed", **kwargs}
    return TaskConfig(name="test", env_id=env_id, max_episode_steps=limit, **kwargs)


def counted(step_counter, *, length, limit, steps, after_failure):
    """The columns of one environment that fails after ``length`` steps."""
    env = FixedHorizonEnv(
        lambda: step_counter(length=length), 1, after_failure=after_failure, max_episode_steps=limit
    )
    batch = play(env, random_actions(env, steps))[0][0]
    after = batch["next"]
    return {
        "from": batch["observation"][:, 1].int().tolist(),
        "to": after["observation"][:, 1].int().tolist(),
        "on": after["following_observation"][:, 1].int().tolist(),
        "ends": after["done"].flatten().nonzero().flatten().tolist(),
        "scored": after["scored"].flatten().int().tolist(),
    }, batch


def test_a_hidden_reset_by_hand(step_counter):
    columns, batch = counted(step_counter, length=3, limit=8, steps=10, after_failure="reset")
    assert columns == {
        "from": [0, 1, 2, 0, 1, 2, 0, 1, 0, 1],
        "to": [1, 2, 3, 1, 2, 3, 1, 2, 1, 2],  # 3, the failed state, is never started from
        "on": [1, 2, 0, 1, 2, 0, 1, 2, 1, 2],
        "ends": [7],
        "scored": [1, 1, 1, 0, 0, 0, 0, 0, 1, 1],
    }
    after = batch["next"]
    assert not after["terminated"].any()
    assert torch.equal(after["truncated"], after["done"])
    # Each episode of the simulator has a start of its own, hidden or not.
    starts = batch["observation"][:, 0]
    assert [len(starts[k].unique()) for k in (slice(3), slice(3, 6), slice(6, 8))] == [1, 1, 1]
    assert len(starts.unique()) == 4
    # The reward is that of the transition, whatever follows it.
    expected = 100.0 * after["observation"][:, 1] + batch["action"][:, 0]
    torch.testing.assert_close(after["reward"][:, 0], expected)


def test_running_on_by_hand(step_counter):
    columns, batch = counted(step_counter, length=3, limit=5, steps=7, after_failure="continue")
    assert columns == {
        "from": [0, 1, 2, 3, 4, 0, 1],
        "to": [1, 2, 3, 4, 5, 1, 2],
        "on": [1, 2, 3, 4, 5, 1, 2],
        "ends": [4],
        "scored": [1, 1, 1, 0, 0, 1, 1],
    }
    assert not batch["next", "terminated"].any()


def test_a_failure_at_the_horizons_end_is_followed_by_another_start(step_counter):
    columns, batch = counted(step_counter, length=3, limit=3, steps=4, after_failure="reset")
    assert columns["to"] == [1, 2, 3, 1] and columns["on"] == [1, 2, 0, 1]
    assert columns["ends"] == [2] and columns["from"] == [0, 1, 2, 0]
    assert not batch["next", "terminated"].any()


def test_seeds_of_hidden_resets_are_those_of_the_episodes_numbers():
    """The second episode begins as the second one of an environment that says when it fails."""
    fixed = FixedHorizonEnv(lambda: gymnasium.make("CartPole-v1"), 3, seed=7, max_episode_steps=60)
    batch, _ = play(fixed, random_actions(fixed, 60))
    after = batch["next"]
    jumped = (after["observation"] != after["following_observation"]).any(-1)
    for i in range(3):
        moments = jumped[i].nonzero().flatten().tolist()
        assert len(moments) >= 1
        for number, moment in enumerate(moments, 1):
            seed = stream_seed("training", 7, i, number, bits=32)
            start = gymnasium.make("CartPole-v1").reset(seed=seed)[0]
            np.testing.assert_array_equal(after["following_observation"][i, moment], start)
            if moment + 1 < 60:
                np.testing.assert_array_equal(batch["observation"][i, moment + 1], start)


def test_without_a_failure_it_is_the_same_environment():
    own = make_env(task("Pendulum-v1", 9, horizon="own"), 3, seed=2)
    fixed = make_env(task("Pendulum-v1", 9), 3, seed=2)
    actions = random_actions(own, 30)
    keys = rollouts.KEYS
    expected, _ = play(own, actions, keys=keys)
    batch, _ = play(fixed, actions)
    for key in keys:
        assert torch.equal(batch[key], expected[key]), key
    assert torch.equal(batch["next", "following_observation"], batch["next", "observation"])
    assert batch["next", "scored"].all() and batch["next", "done"].any()


def test_up_to_the_first_failure_it_is_the_task_itself():
    own = make_env(task("CartPole-v1", horizon="own"), 4, seed=1)
    actions = random_actions(own, 60)
    expected, _ = play(own, actions, keys=rollouts.KEYS)
    for after_failure in ("reset", "continue"):
        fixed = make_env(task("CartPole-v1", 60, after_failure=after_failure), 4, seed=1)
        batch, _ = play(fixed, actions)
        for i in range(4):
            length = int(expected["next", "done"][i].flatten().nonzero()[0]) + 1
            scored = batch["next", "scored"][i].flatten()
            assert scored.nonzero().flatten().tolist() == list(range(length))
            for key in ("observation", ("next", "observation"), ("next", "reward")):
                assert torch.equal(batch[key][i, :length], expected[key][i, :length])


@pytest.mark.parametrize(
    "env_id",
    [
        BULLET,
        "InvertedDoublePendulumBulletEnv-v0",
        "HopperBulletEnv-v0",
        "Walker2DBulletEnv-v0",
    ],
)
def test_pybullet_runs_on_after_a_failure(env_id):
    env = make_env(task(env_id, 150, after_failure="continue"), 2, seed=0)
    batch, _ = play(env, random_actions(env, 150))
    after = batch["next"]
    assert not after["scored"][:, -1].any() and after["scored"][:, 0].all()
    assert after["observation"].isfinite().all() and after["reward"].isfinite().all()
    assert torch.equal(after["observation"][:, :-1], batch["observation"][:, 1:])
    # It moves all the time: nothing is frozen at the failure.
    assert (after["observation"] != batch["observation"]).any(-1).all()
    if env_id == BULLET:
        assert after["observation"][..., 2].min() < -0.9  # cos of the angle: it hangs
    env.close()


@pytest.mark.parametrize("after_failure", ["reset", "continue"])
@pytest.mark.parametrize(
    ("env_id", "limit"), [("CartPole-v1", 38), (BULLET, 38), ("HopperBulletEnv-v0", 25)]
)
@pytest.mark.parametrize("before", [0, 1, 37])
def test_a_restored_simulator_continues_bit_for_bit(env_id, limit, after_failure, before, tmp_path):
    settings = task(env_id, limit, after_failure=after_failure)
    env, fresh = make_env(settings, 3, seed=3), make_env(settings, 3, seed=99)
    whole = rollouts.continued(env, fresh, before, tmp_path / "state", KEYS)
    assert not whole["next", "scored"].all()
    env.close()
    fresh.close()


def test_the_history_goes_back_no_further_than_the_last_reset_of_a_simulator():
    env = make_env(task("CartPole-v1", 500), 4, seed=0)
    play(env, random_actions(env, 300))
    state = env.simulator_state()
    assert state["steps"].tolist() == [300] * 4
    assert state["played"].max() <= len(state["actions"]) < 150


@pytest.mark.parametrize("after_failure", ["reset", "continue"])
@pytest.mark.parametrize("env_id", ["Pendulum-v1", "CartPole-v1", BULLET])
def test_specs_are_kept(env_id, after_failure):
    env = make_env(task(env_id, after_failure=after_failure), 2, seed=0)
    for stop in (True, False):
        check_env_specs(env, break_when_any_done=stop)
    env.close()


def test_a_collector_brings_what_follows(step_counter):
    env = FixedHorizonEnv(lambda: step_counter(length=4), 2, max_episode_steps=10)
    collector = Collector(env, env.rand_action, frames_per_batch=24, total_frames=24)
    (batch,) = collector
    expected = [0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 0, 1]
    following = [1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 1, 2]
    for row in batch:
        assert row["observation"][:, 1].int().tolist() == expected
        assert row["next", "following_observation"][:, 1].int().tolist() == following
    collector.shutdown()


def test_the_tasks_own_episodes_have_nothing_added():
    env = make_env(task("CartPole-v1", horizon="own"), 2, seed=0)
    assert type(env) is GymVectorEnv
    root = env.reset()
    transition, _ = env.step_and_maybe_reset(env.rand_action(root))
    assert set(root.keys()) == {"observation", "done", "terminated", "truncated", "action", "next"}
    assert set(transition["next"].keys()) == {
        *("observation", "reward", "done", "terminated", "truncated")
    }


def test_own_episodes_of_a_task_with_a_fixed_horizon():
    fixed = task("CartPole-v1", 30, after_failure="continue")
    assert with_own_episodes(fixed) == replace(fixed, horizon="own", after_failure="reset")


def test_no_limit_is_no_horizon(step_counter):
    with pytest.raises(UserError, match=r"no fixed horizon: set task\.max_episode_steps\.$"):
        FixedHorizonEnv(step_counter, 1)
