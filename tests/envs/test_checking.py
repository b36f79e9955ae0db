"""What numpy would take without a word: other shapes, no reward, one simulator for all."""

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit

from giril_rl.demos import record_demonstration
from giril_rl.envs import GymVectorEnv
from giril_rl.errors import UserError


def returning(base, *, reset=None, step=None):
    """A StepCounter whose ``reset`` or ``step`` returns something else."""

    class Other(base):
        def reset(self, **kwargs):
            returned = super().reset(**kwargs)
            return returned if reset is None else reset(*returned)

        def step(self, action):
            returned = super().step(action)
            return returned if step is None else step(*returned)

    return Other


WRONG = {
    "a narrow first observation": (
        {"reset": lambda o, info: (o[:1], info)},
        "Other shows an observation of shape [1], and its observation_space is of shape [3]",
    ),
    "a single number": ({"reset": lambda o, info: (o[0], info)}, "of shape []"),
    "a narrow observation": (
        {"step": lambda o, *rest: (o[:1], *rest)},
        "Other shows an observation of shape [1], and its observation_space is of shape [3]",
    ),
    "a column": ({"step": lambda o, *rest: (o[:, None], *rest)}, "of shape [3, 1]"),
    "no reward": (
        {"step": lambda o, reward, *rest: (o, None, *rest)},
        "Other.step returns None as reward: it must be a number.",
    ),
    "two rewards": (
        {"step": lambda o, reward, *rest: (o, np.ones(2), *rest)},
        "as reward: it must be a number.",
    ),
    "no end": (
        {"step": lambda o, reward, end, cut, info: (o, reward, None, cut, info)},
        "Other.step returns None as terminated: it must be True or False.",
    ),
    "a reset of old": ({"reset": lambda o, info: o}, "returns no pair of observation and info"),
    "a step of old": (
        {"step": lambda o, reward, end, cut, info: (o, reward, end, info)},
        "does not return observation, reward, terminated, truncated and info",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_returned_is_held_to_the_spaces(case, step_counter):
    kwargs, sentence = WRONG[case]
    make_fn = returning(step_counter, **kwargs)
    with pytest.raises(UserError) as raised:
        GymVectorEnv(make_fn, 2).rollout(1)
    assert sentence in str(raised.value) and str(raised.value)[-1] == "."
    with pytest.raises(UserError) as recorded:
        record_demonstration(make_fn, lambda o: o[:, 2:] * 0, length=3, seed=0)
    assert str(recorded.value) == str(raised.value)


@pytest.mark.parametrize("wrapped", [lambda env: env, lambda env: TimeLimit(env, 9)])
def test_one_environment_cannot_be_several(wrapped, step_counter):
    env = step_counter()
    with pytest.raises(UserError, match=r"the same StepCounter several times, .* 3 episodes"):
        GymVectorEnv(lambda: wrapped(env), 3)
    assert GymVectorEnv(lambda: wrapped(env), 1).batch_size == (1,)


def test_copies_are_of_one_kind(step_counter):
    def differing(**spaces_of):
        numbers = iter(range(2))

        def make_fn():
            env, number = step_counter(), next(numbers)
            for name, made in spaces_of.items():
                setattr(env, name, made(number))
            return env

        return make_fn

    with pytest.raises(UserError, match="differ in their action_space"):
        GymVectorEnv(differing(action_space=lambda i: spaces.Box(-1.0 - i, 1.0, (1,))), 2)
    with pytest.raises(UserError, match="differ in their observation_space"):
        GymVectorEnv(differing(observation_space=lambda i: spaces.Box(-1.0, 1.0, (3 + i,))), 2)
    limits = iter((5, 9))
    with pytest.raises(UserError, match="differ in their time limit"):
        GymVectorEnv(lambda: TimeLimit(step_counter(), next(limits)), 2)


@pytest.mark.parametrize("dtype", [np.uint8, np.int64, np.bool_])
def test_whole_numbers_are_observed_as_float32(dtype, step_counter):
    class Whole(step_counter):
        def __init__(self):
            super().__init__(length=4)
            low, high = (0, 1) if dtype == np.bool_ else (0, 100)
            self.observation_space = spaces.Box(low, high, (3,), dtype)

        def reset(self, **kwargs):
            observation, info = super().reset(**kwargs)
            return observation.astype(dtype), info

        def step(self, action):
            observation, *rest = super().step(action)
            return observation.astype(dtype), *rest

    batch = GymVectorEnv(Whole, 1).rollout(4)
    shown = [1.0, 1.0, 1.0, 1.0] if dtype == np.bool_ else [1.0, 2.0, 3.0, 4.0]
    assert batch["next", "observation"][0, :, 1].tolist() == shown
    demo = record_demonstration(Whole, lambda o: o[:, 2:] * 0, episodes=1, seed=0)
    assert demo.transitions["next", "observation"][:, 1].tolist() == shown


def test_gymnasium_reads_the_same(step_counter):
    """The checks pass what Gymnasium's own wrappers return."""
    env = gymnasium.wrappers.RecordEpisodeStatistics(step_counter(length=4))
    assert GymVectorEnv(lambda: env, 1).rollout(9)["next", "done"].sum() == 1
