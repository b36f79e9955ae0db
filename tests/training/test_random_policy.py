import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, MultiCategorical, OneHot, Unbounded

from giril_rl.config.schema import TaskConfig
from giril_rl.errors import UserError
from giril_rl.training import HeldAction, RandomPolicy
from giril_rl.training.scoring import evaluate

CARTPOLE = TaskConfig(name="cartpole", env_id="CartPole-v1")


def test_uniform_over_a_box():
    low, high = torch.tensor([-1.0, 0.0]).expand(16, 2), torch.tensor([3.0, 0.5]).expand(16, 2)
    policy = RandomPolicy(Bounded(low, high, shape=(16, 2)))
    action = policy(TensorDict(batch_size=[40_000]))["action"]
    assert action.shape == (40_000, 2)
    for column, (a, b) in zip(action.T, ((-1.0, 3.0), (0.0, 0.5)), strict=True):
        assert a <= column.min() and column.max() <= b
        unit = (column - a) / (b - a)
        quarters = torch.histc(unit, 4, 0, 1) / len(unit)
        assert (quarters - 0.25).abs().max() < 0.01


def test_uniform_over_classes():
    action = RandomPolicy(Categorical(3, shape=(2,)))(TensorDict(batch_size=[30_000]))["action"]
    assert action.shape == (30_000,) and action.dtype == torch.int64
    assert (torch.bincount(action, minlength=3) / 30_000 - 1 / 3).abs().max() < 0.02


def test_refuses_actions_without_bounds():
    for spec in (Unbounded((2, 1)), Bounded(0.0, float("inf"), shape=(2, 1))):
        with pytest.raises(UserError, match="no uniform distribution"):
            RandomPolicy(spec)
    with pytest.raises(UserError, match="is not supported"):
        RandomPolicy(MultiCategorical([2, 3], shape=(1, 2)))


def test_one_action_of_any_encoding_is_held():
    for spec, action in ((Categorical(3, shape=(2,)), 2), (OneHot(3, shape=(2, 3)), [0, 0, 1])):
        held = HeldAction(spec, 2)(TensorDict(batch_size=[2, 4]))["action"]
        assert torch.equal(held, torch.tensor(action).expand(held.shape))
        assert held.shape[:2] == (2, 4) and held.dtype == torch.int64
    for spec in (MultiCategorical([2, 3]), Bounded(0, 3, shape=(1,), dtype=torch.int64)):
        with pytest.raises(UserError, match="is not supported"):
            HeldAction(spec, 0)


def test_its_score_is_that_of_random_play():
    """CartPole's random policy lasts about 22 steps: measured here by hand, without our parts."""
    scores = evaluate(
        RandomPolicy.of_task(CARTPOLE), CARTPOLE, episodes=300, seed=0, deterministic=False
    )
    env, generator, lengths = gymnasium.make("CartPole-v1"), np.random.default_rng(0), []
    for episode in range(300):
        env.reset(seed=episode)
        length, done = 0, False
        while not done:
            _, _, terminated, truncated, _ = env.step(int(generator.integers(2)))
            length, done = length + 1, terminated or truncated
        lengths.append(length)
    assert len(set(scores.returns)) > 10
    # The standard error of either mean is about 0.7.
    assert abs(scores.return_mean - np.mean(lengths)) < 4


def test_evaluation_seeds_decide_its_score():
    policy = RandomPolicy.of_task(CARTPOLE)
    one, two, other = (
        evaluate(policy, CARTPOLE, episodes=5, seed=seed, deterministic=deterministic).returns
        for seed, deterministic in ((0, False), (0, True), (1, False))
    )
    assert one == two != other


def test_two_seeds_are_two_policies_in_the_same_episodes():
    """Evaluation draws the same episodes for every run: five seeds must not be one result."""
    one, again, other = (
        evaluate(
            RandomPolicy.of_task(CARTPOLE, seed), CARTPOLE, episodes=5, seed=0, deterministic=False
        ).returns
        for seed in (0, 0, 1)
    )
    assert one == again != other


def test_leaves_the_global_generator_alone():
    state = torch.get_rng_state()
    policy = RandomPolicy(Categorical(3, shape=(2,)))
    first, second = (policy(TensorDict(batch_size=[50]))["action"] for _ in range(2))
    assert torch.equal(torch.get_rng_state(), state)
    assert not torch.equal(first, second)
    assert torch.equal(policy.acting()(TensorDict(batch_size=[50]))["action"], first)
