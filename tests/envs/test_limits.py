"""The shortest time limit counts, wherever it is."""

import gymnasium
import pytest
from gymnasium.wrappers import TimeLimit

from giril_rl.envs import FixedHorizonEnv, GymVectorEnv
from giril_rl.errors import UserError


def ends(env, steps=12):
    """The steps of the first environment at which an episode ends."""
    batch = env.rollout(steps, break_when_any_done=False)
    return batch["next", "truncated"][0].flatten().nonzero().flatten().tolist()


LIMITS = {
    "inner": (lambda env: TimeLimit(TimeLimit(env, 5), 9), None),
    "outer": (lambda env: TimeLimit(TimeLimit(env, 9), 5), None),
    "below another wrapper": (lambda env: gymnasium.Wrapper(TimeLimit(env, 5)), None),
    "far below": (lambda env: TimeLimit(gymnasium.Wrapper(TimeLimit(env, 5)), 9), None),
    "given": (lambda env: TimeLimit(env, 9), 5),
    "shorter than the given": (lambda env: TimeLimit(env, 5), 9),
    "below another wrapper, and given": (lambda env: gymnasium.Wrapper(TimeLimit(env, 5)), 9),
}


@pytest.mark.parametrize("case", LIMITS)
def test_the_shortest_counts(case, step_counter):
    wrapped, given = LIMITS[case]
    env = GymVectorEnv(lambda: wrapped(step_counter(length=99)), 2, max_episode_steps=given)
    assert ends(env) == [4, 9]
    # A failure at the third step begins the simulator's own clocks anew, not the horizon.
    for length in (99, 3):
        make_fn = lambda length=length: wrapped(step_counter(length=length))  # noqa: E731
        assert ends(FixedHorizonEnv(make_fn, 2, max_episode_steps=given)) == [4, 9]


def test_nested_limits_of_a_registered_environment():
    env = GymVectorEnv(lambda: TimeLimit(gymnasium.make("Pendulum-v1"), 50), 1)
    assert ends(env, 110) == [49, 99]


def test_a_wrapper_that_is_more_than_a_time_limit_stays(step_counter):
    class Taxed(TimeLimit):
        def step(self, action):
            observation, reward, *rest = super().step(action)
            return observation, reward - 1000.0, *rest

    env = GymVectorEnv(lambda: Taxed(step_counter(length=99), 5), 1)
    env.reset()
    batch = env.rollout(6, break_when_any_done=False)["next"]
    assert batch["truncated"].flatten().nonzero().flatten().tolist() == [4]
    assert (batch["reward"] < -300).all()  # At most 500 and the action, without the tax.


def test_an_environment_that_cuts_by_itself_has_no_longer_horizon(step_counter):
    class Cutting(step_counter):
        def step(self, action):
            observation, reward, failed, _, info = super().step(action)
            return observation, reward, failed, bool(observation[1] >= 4), info

    def make_fn():
        return Cutting(length=99)

    with pytest.raises(UserError, match=r"Cutting truncates .* after 4 steps, .*_steps=4\.$"):
        FixedHorizonEnv(make_fn, 2, max_episode_steps=6).rollout(9, break_when_any_done=False)
    assert ends(FixedHorizonEnv(make_fn, 2, max_episode_steps=4)) == [3, 7, 11]


def test_a_limit_of_no_step_is_refused(step_counter):
    with pytest.raises(UserError, match=r"max_episode_steps=0: at least 1"):
        GymVectorEnv(step_counter, 1, max_episode_steps=0)
