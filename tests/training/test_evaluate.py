import gymnasium
import numpy as np
import pytest
import torch

from giril_rl.configs import TaskConfig
from giril_rl.envs import make_env
from giril_rl.networks.policy import ActorCritic
from giril_rl.randomness import stream_seed
from giril_rl.training.evaluate import evaluate, evaluate_both

COUNTER = TaskConfig(name="counter", env_id="StepCounter-v0")
CARTPOLE = TaskConfig(name="cartpole", env_id="CartPole-v1")


def make_agent(task):
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        env = make_env(task, 1, seed=0)
        size = env.observation_spec["observation"].shape[-1]
        agent = ActorCritic(size, env.action_spec, hidden=(16,))
        with torch.no_grad():
            agent.actor[-1].weight.mul_(100)
        agent.update_normaliser(torch.randn(50, size) * 3 + 1)
    return agent


@pytest.mark.parametrize("task", [COUNTER, CARTPOLE], ids=lambda task: task.name)
def test_scores_are_those_of_one_whole_episode_in_each_environment(task):
    """Episodes of the counter last 1 to 11 steps; counting the first ones to end would show."""
    agent = make_agent(task)
    scores = evaluate(agent, task, episodes=12, seed=4, deterministic=True)
    returns, lengths = [], []
    for i in range(12):
        env = gymnasium.make(task.env_id, disable_env_checker=True)
        seed = stream_seed("evaluation", 4, i, 0, bits=32)
        observation, done, total, length = env.reset(seed=seed)[0], False, 0.0, 0
        while not done:
            with torch.no_grad():
                out = agent.actor(agent.normaliser(torch.from_numpy(observation.copy())))
            action = out.argmax().item() if agent.discrete else out.numpy()
            observation, reward, terminated, truncated, _ = env.step(action)
            total, length, done = total + reward, length + 1, terminated or truncated
        returns.append(total)
        lengths.append(length)
    assert len(set(lengths)) > (3 if task is COUNTER else 1)
    assert scores.returns == pytest.approx(returns, rel=1e-5)
    assert scores.return_mean == pytest.approx(np.mean(returns), rel=1e-5)
    assert scores.return_std == pytest.approx(np.std(returns, ddof=1), rel=1e-5)
    assert scores.return_median == pytest.approx(np.median(returns), rel=1e-5)
    assert scores.episode_length_mean == np.mean(lengths)
    assert scores.episodes == len(scores.returns) == 12
    assert scores.life_length_mean is None


def test_a_time_limit_ends_an_episode():
    task = TaskConfig(name="pendulum", env_id="Pendulum-v1", max_episode_steps=7)
    scores = evaluate(make_agent(task), task, episodes=2, seed=0, deterministic=True)
    assert scores.episode_length_mean == 7


def test_one_episode_has_no_deviation():
    agent = make_agent(COUNTER)
    assert evaluate(agent, COUNTER, episodes=1, seed=0, deterministic=True).return_std == 0.0


def test_sampled_and_deterministic_play_differ_and_repeat():
    agent = make_agent(COUNTER)

    def returns(deterministic, seed=0):
        return evaluate(agent, COUNTER, episodes=6, seed=seed, deterministic=deterministic).returns

    sampled, greedy = returns(False), returns(True)
    assert sampled != greedy
    torch.manual_seed(123)
    assert (returns(False), returns(True)) == (sampled, greedy)
    assert returns(True, seed=1) != greedy
    both = evaluate_both(agent, COUNTER, episodes=6, seed=0)
    assert both["deterministic"]["returns"] == greedy
    assert both["returns"] == sampled
    assert set(both) - {"deterministic"} == set(both["deterministic"])


@pytest.mark.parametrize("deterministic", [True, False])
def test_neither_random_state_nor_agent_changes(deterministic):
    agent = make_agent(CARTPOLE)
    before = {name: value.clone() for name, value in agent.state_dict().items()}
    state, numpy_state = torch.get_rng_state(), np.random.get_state()[1].copy()
    evaluate(agent, CARTPOLE, episodes=3, seed=0, deterministic=deterministic)
    assert torch.equal(torch.get_rng_state(), state)
    assert np.array_equal(np.random.get_state()[1], numpy_state)
    for name, value in agent.state_dict().items():
        assert torch.equal(value, before[name]), name


def test_simulators_are_closed(monkeypatch):
    from gymnasium.envs.classic_control.cartpole import CartPoleEnv

    closed = []
    monkeypatch.setattr(CartPoleEnv, "close", lambda self: closed.append(self))
    evaluate(make_agent(CARTPOLE), CARTPOLE, episodes=5, seed=0, deterministic=True)
    assert len(closed) >= 5
