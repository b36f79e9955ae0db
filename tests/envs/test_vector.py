import ctypes
import itertools
from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from rollouts import BULLET, KEYS, continued, play, random_actions
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.envs.utils import check_env_specs

from giril_rl.config.schema import TaskConfig
from giril_rl.demos import record_demonstration
from giril_rl.envs import GymVectorEnv, make_env
from giril_rl.errors import UserError
from giril_rl.rewards.actions import ActionEncoder
from giril_rl.runs.randomness import stream_seed


def make(env_id, num_envs=3, *, seed=0, limit=None):
    task = TaskConfig(name="test", env_id=env_id, max_episode_steps=limit)
    return make_env(task, num_envs, seed)


def gymnasium_loop(make_fn, actions, seed):
    """The same with Gymnasium alone, one environment after the other."""
    columns = {key: [] for key in KEYS}
    for i in range(actions.shape[1]):
        env = make_fn()
        seeds = (stream_seed("training", seed, i, n, bits=32) for n in itertools.count())
        observation = env.reset(seed=next(seeds))[0].copy()
        rows = {key: [] for key in KEYS}
        for action in actions[:, i].numpy():
            following, reward, terminated, truncated, _ = env.step(action)
            done = terminated or truncated
            following = following.copy()
            values = (observation, action, following, reward, done, terminated, truncated)
            for key, value in zip(KEYS, values, strict=True):
                rows[key].append(value)
            observation = env.reset(seed=next(seeds))[0].copy() if done else following
        env.close()
        for key in KEYS:
            columns[key].append(np.stack(rows[key]))
    return {key: np.stack(value) for key, value in columns.items()}


@pytest.mark.parametrize(
    ("env_id", "limit"),
    [("CartPole-v1", None), ("CartPole-v1", 14), ("Pendulum-v1", 7), (BULLET, 15)],
)
def test_equals_a_loop_over_gymnasium_environments(env_id, limit):
    env = make(env_id, seed=5, limit=limit)
    actions = random_actions(env, 80)
    batch, _ = play(env, actions)
    extra = {} if limit is None else {"max_episode_steps": limit}
    expected = gymnasium_loop(partial(gymnasium.make, env_id, **extra), actions, seed=5)
    for key in KEYS:
        found = batch[key].numpy()
        if key[-1] in ("reward", "done", "terminated", "truncated"):
            found = found[..., 0]
        np.testing.assert_array_equal(found, expected[key].astype(found.dtype), err_msg=str(key))
    assert batch["next", "done"].sum() >= 9  # Otherwise little was compared.
    if limit is not None:
        assert batch["next", "truncated"].any()
    env.close()


@pytest.mark.parametrize(
    ("env_id", "limit"), [("CartPole-v1", 14), ("Pendulum-v1", 7), ("StepCounter-v0", None)]
)
def test_equals_the_general_step_of_torchrl(env_id, limit):
    env, other = make(env_id, limit=limit), make(env_id, limit=limit)
    actions = random_actions(env, 40)
    batch, root = play(env, actions)
    expected, expected_root = play(other, actions, step=EnvBase.step_and_maybe_reset)
    assert expected["next", "done"].any()
    for key in KEYS:
        assert torch.equal(batch[key], expected[key]), key
    for key in ("observation", "done", "terminated", "truncated"):
        assert torch.equal(root[key], expected_root[key]), key


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "CartPole-v1", BULLET])
def test_specs_are_kept(env_id):
    env = make(env_id, 2)
    for stop in (True, False):
        check_env_specs(env, break_when_any_done=stop)
    env.close()


def test_kinds_of_actions(step_counter):
    box = GymVectorEnv(step_counter, 2).action_spec
    assert box.shape == (2, 1) and box.dtype == torch.float32
    assert box.space.low.min() == -1 and box.space.high.max() == 1
    discrete = GymVectorEnv(lambda: step_counter(discrete=True), 2).action_spec
    assert discrete.shape == (2,) and discrete.dtype == torch.int64 and discrete.space.n == 3

    def unbounded():
        env = step_counter()
        env.action_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        return env

    assert GymVectorEnv(unbounded, 2).action_spec.shape == (2, 2)


BOXES = {
    "half": ([0.0, 0.0], [np.inf, np.inf], [[-3.0, 7.0]], [[0.0, 7.0]]),
    "one of two": ([-1.0, -np.inf], [1.0, np.inf], [[3.0, -30.0]], [[1.0, -30.0]]),
    "the largest number": ([-1.0, -3.5e38], [1.0, 3.5e38], [[3.0, -30.0]], [[1.0, -30.0]]),
    "none": ([-np.inf] * 2, [np.inf] * 2, [[-3.0, 30.0]], [[-3.0, 30.0]]),
}


@pytest.mark.parametrize("case", BOXES)
def test_each_dimension_is_clamped_to_the_bounds_that_it_has(case, step_counter):
    low, high, given, executed = BOXES[case]

    def make_fn():
        env = step_counter(length=99)
        env.action_space = spaces.Box(np.array(low), np.array(high), dtype=np.float64)
        return env

    env = GymVectorEnv(make_fn, 1)
    _, root = play(env, [torch.tensor(given)])
    assert root["observation"][0, 2] == sum(executed[0])
    assert env.simulator_state()["actions"].tolist() == [executed]
    assert ActionEncoder(env.action_spec)(torch.tensor(given)).tolist() == executed
    demo = record_demonstration(make_fn, lambda o: torch.tensor(given), length=2, seed=0)
    assert demo.transitions["action"][:1].tolist() == executed
    # TorchRL draws NaN where a bound is missing.
    drawn = env.rollout(200)["action"][0]
    assert drawn.isfinite().all() and drawn.abs().max() < 30
    inside = (drawn >= torch.tensor(low)) & (drawn <= torch.tensor(high))
    assert inside.all() and drawn.std(0).min() > 0.3


def test_transitions_are_aligned_in_a_collected_batch(step_counter):
    """Each environment ends after four steps; what is seen and paid names step and action."""
    env = GymVectorEnv(lambda: step_counter(length=4), 2, seed=1)
    collector = Collector(env, env.rand_action, frames_per_batch=22, total_frames=22)
    (batch,) = collector
    step = torch.arange(11) % 4
    for i in range(2):
        row = batch[i]
        action = row["action"][:, 0]
        assert row["observation"][:, 1].tolist() == step.tolist()
        assert row["next", "observation"][:, 1].tolist() == (step + 1).tolist()  # 4 is terminal
        assert torch.equal(row["next", "observation"][:, 2], action)
        torch.testing.assert_close(row["next", "reward"][:, 0], 100.0 * (step + 1) + action)
        assert row["next", "done"][:, 0].tolist() == (step == 3).tolist()
        # An episode's start is its own: constant in it, another one in the next.
        starts, following = row["observation"][:, 0], row["next", "observation"][:, 0]
        assert torch.equal(starts, following)
        assert [len(starts[k : k + 4].unique()) for k in (0, 4, 8)] == [1, 1, 1]
        assert len(starts.unique()) == 3
    assert batch["action"].unique().numel() == 22
    collector.shutdown()


def test_limits_truncate_and_failures_terminate(step_counter):
    def flags(length, limit):
        env = GymVectorEnv(lambda: step_counter(length=length), 1, max_episode_steps=limit)
        batch, _ = play(env, random_actions(env, 5))
        names = ("done", "terminated", "truncated")
        return [batch["next", name].flatten().nonzero().flatten().tolist() for name in names]

    assert flags(length=3, limit=99) == [[2], [2], []]
    assert flags(length=99, limit=3) == [[2], [], [2]]
    assert flags(length=3, limit=3) == [[2], [2], [2]]  # As Gymnasium's TimeLimit.
    assert flags(length=99, limit=None) == [[], [], []]


def test_the_registered_limit_holds_unless_another_is_given():
    def length(**kwargs):
        env = GymVectorEnv(lambda: gymnasium.make("Pendulum-v1", **kwargs), 1)
        done = env.rollout(210, break_when_any_done=True)["next", "truncated"]
        assert done[0, -1]
        return done.shape[1]

    assert length() == 200
    assert length(max_episode_steps=9) == 9


def test_only_the_named_environments_are_reset():
    env = make("CartPole-v1", 3)
    actions = random_actions(env, 4)
    batch, root = play(env, actions)
    assert not batch["next", "done"].any()
    mask = torch.tensor([[False], [True], [False]])
    fresh = env.reset(root.clone().set("_reset", mask))
    assert torch.equal(fresh["observation"][[0, 2]], root["observation"][[0, 2]])
    assert not torch.equal(fresh["observation"][1], root["observation"][1])
    # The second episode's beginning, not the first's again.
    assert not torch.equal(fresh["observation"][1], batch["observation"][1, 0])
    # The others go on as if nothing had happened, and their clocks with them.
    onward, _ = play(env, actions, root=fresh)
    whole, _ = play(make("CartPole-v1", 3), torch.cat([actions, actions]))
    others = whole[[0, 2], 4:]
    assert torch.equal(onward["next", "observation"][[0, 2]], others["next", "observation"])
    assert env.simulator_state()["steps"].tolist() == [8, 4, 8]


def test_data_follow_from_the_seed():
    def observations(**kwargs):
        env = make("CartPole-v1", 3, **kwargs)
        return play(env, random_actions(env, 60))[0]["observation"]

    first = observations(seed=1)
    assert torch.equal(first, observations(seed=1))
    assert not (first[:, 0] == observations(seed=2)[:, 0]).any()
    # No two copies and no two episodes begin alike.
    assert first[:, 0].unique(dim=0).shape[0] == 3
    env = make("CartPole-v1", 3)
    starts = torch.cat([env.reset()["observation"] for _ in range(5)])
    assert starts.unique(dim=0).shape[0] == 15
    env.set_seed(1)
    assert torch.equal(env.reset()["observation"], first[:, 0])


def test_recorded_data_stay_as_they_were(step_counter):
    """Neither the simulator's reused array nor the caller's reused memory shows through."""
    env = GymVectorEnv(lambda: step_counter(length=100), 2)
    first, _ = env.step_and_maybe_reset(env.rand_action(env.reset()))
    kept = first.clone()
    action = torch.zeros(2, 1)
    root = env.reset()
    for number in range(3):
        action.fill_(number)
        _, root = env.step_and_maybe_reset(root.set("action", action))
    assert torch.equal(first["next", "observation"], kept["next", "observation"])
    # The third action, 2, was executed as the bound.
    assert env.simulator_state()["actions"].flatten().tolist() == [0, 0, 1, 1, 1, 1]


@pytest.mark.parametrize(
    ("env_id", "limit"),
    [("CartPole-v1", None), ("Pendulum-v1", 9), (BULLET, 15), ("StepCounter-v0", None)],
)
@pytest.mark.parametrize("before", [0, 1, 37])
def test_a_restored_simulator_continues_bit_for_bit(env_id, limit, before, tmp_path):
    env, fresh = make(env_id, seed=3, limit=limit), make(env_id, seed=99, limit=limit)
    continued(env, fresh, before, tmp_path / "state")
    # Only the first reset stands in the middle of episodes.
    assert torch.equal(env.reset()["observation"], fresh.reset()["observation"])
    assert fresh.simulator_state()["steps"].tolist() == [0, 0, 0]
    env.close()
    fresh.close()


def test_the_history_goes_back_no_further_than_the_running_episodes():
    env = make("CartPole-v1", 4)
    longest = play(env, random_actions(env, 300))[0]["next", "done"].shape[1]
    state = env.simulator_state()
    assert state["steps"].max() <= len(state["actions"]) < longest / 2


class Restless(gymnasium.Wrapper):
    """A simulator that does not repeat itself."""

    def step(self, action):
        observation, *rest = self.env.step(action)
        return observation + np.random.uniform(size=observation.shape), *rest


def test_a_simulator_that_does_not_repeat_itself_begins_its_next_episodes():
    def make_fn():
        return Restless(gymnasium.make("CartPole-v1"))

    env = GymVectorEnv(make_fn, 2, seed=4)
    play(env, random_actions(env, 3))
    fresh = GymVectorEnv(make_fn, 2)
    assert not fresh.restore_simulator(env.simulator_state())
    # A reset is repeatable, so that these are the ones that would have come next.
    assert torch.equal(fresh.reset()["observation"], env.reset()["observation"])
    for key in ("seed", "episode", "steps", "actions"):
        assert np.array_equal(fresh.simulator_state()[key], env.simulator_state()[key]), key


def test_a_replay_stops_where_an_episode_ends_too_early(step_counter):
    """Some simulators raise an error when they are stepped after that."""

    class Strict(step_counter):
        ended = False

        def step(self, action):
            assert not self.ended
            *shown, self.ended, cut, info = super().step(action)
            return *shown, self.ended, cut, info

    env = GymVectorEnv(lambda: Strict(length=9), 1)
    play(env, random_actions(env, 5))
    assert not GymVectorEnv(lambda: Strict(length=2), 1).restore_simulator(env.simulator_state())


@pytest.mark.parametrize(
    ("env_id", "changes", "sentence"),
    [
        ("CartPole-v1", {"actions": torch.full((3, 2), 2)}, "not ones of this task"),
        ("CartPole-v1", {"actions": torch.zeros(3, 1).long()}, "another shape or type"),
        ("CartPole-v1", {"actions": torch.zeros(2, 2).long()}, "'steps' is not between 0 and 2"),
        ("CartPole-v1", {"steps": torch.zeros(2)}, "'steps' is not int64"),
        ("CartPole-v1", {"observation": "x"}, "'observation' is not a tensor"),
        ("CartPole-v1", {"seed": 0.5}, "not a natural number"),
        (BULLET, {"actions": torch.full((3, 2, 1), 1.5)}, "not ones of this task"),
        (BULLET, {"actions": torch.full((3, 2, 1), torch.nan)}, "not ones of this task"),
        (BULLET, {"actions": torch.zeros(3, 2, 1).long()}, "another shape or type"),
    ],
)
def test_a_damaged_state_is_refused_before_anything_is_played(env_id, changes, sentence):
    env = make(env_id, 2)
    play(env, random_actions(env, 3))
    state = {**env.simulator_state(), **changes}
    other = make(env_id, 2)
    with pytest.raises(ValueError, match=sentence):
        other.restore_simulator(state)


@pytest.mark.parametrize(
    ("name", "space"),
    [
        ("observation", spaces.Box(0, 255, (8, 8, 3), np.uint8)),
        ("observation", spaces.Discrete(4)),
        ("observation", spaces.Dict({"position": spaces.Box(-1, 1, (2,))})),
        ("action", spaces.MultiDiscrete([2, 3])),
        ("action", spaces.Box(-1, 1, (2, 2))),
        ("action", spaces.Discrete(3, start=1)),
        ("action", spaces.Box(-3, 3, (1,), np.int64)),
    ],
    ids=str,
)
def test_other_spaces_are_refused_in_one_sentence(step_counter, name, space):
    def make_fn():
        env = step_counter()
        setattr(env, f"{name}_space", space)
        return env

    with pytest.raises(UserError) as raised:
        GymVectorEnv(make_fn, 1)
    message = str(raised.value)
    remedy = {
        "Discrete(3, start=1)": ", and actions are counted from 0 here: shift them in a wrapper",
        "Box(-3, 3, (1,), int64)": ", whole numbers, and a policy plays real ones in a Box: give",
    }.get(str(space), ": choose a task with")
    assert message.startswith(f"StepCounter has {name}s of the kind {space}{remedy}")
    assert message.endswith(".") and "\n" not in message
    if name == "action":
        with pytest.raises(UserError) as recorded:
            record_demonstration(make_fn, lambda o: o[:, :1], length=3, seed=0)
        assert str(recorded.value) == message


def test_bullet_prints_nothing(capfd):
    env = make(BULLET, 2)
    play(env, random_actions(env, 3))
    other = make(BULLET, 2)
    other.restore_simulator(env.simulator_state())
    ctypes.CDLL(None).fflush(None)  # What C code has printed may still be in its buffer.
    assert capfd.readouterr().out == ""
    env.close()
    other.close()


def test_standard_output_works_again_afterwards(capfd):
    make("CartPole-v1", 1).reset()
    print("heard")
    assert capfd.readouterr().out == "heard\n"


def test_closing_closes_every_copy(step_counter):
    closed = []

    class Closing(step_counter):
        def close(self):
            closed.append(self)

    env = GymVectorEnv(Closing, 3)
    env.close()
    assert len(set(map(id, closed))) == 3
    env.close(raise_if_closed=False)
    assert len(closed) == 3


def test_rewards_and_observations_are_float32():
    env = make("Pendulum-v1", 2)
    step, _ = env.step_and_maybe_reset(
        TensorDict({"action": torch.zeros(2, 1), "observation": env.reset()["observation"]}, [2])
    )
    assert step["next", "reward"].shape == (2, 1)
    assert {step["next", name].dtype for name in ("observation", "reward")} == {torch.float32}
