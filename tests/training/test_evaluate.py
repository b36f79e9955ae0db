import subprocess
import sys

import gymnasium
import numpy as np
import pytest
import torch

from giril_rl.config.schema import TaskConfig
from giril_rl.envs import make_env
from giril_rl.errors import UserError
from giril_rl.policies.actor_critic import ActorCritic
from giril_rl.runs.randomness import stream_seed
from giril_rl.training.scoring import EPISODES_AT_ONCE, evaluate, evaluate_both

COUNTER = TaskConfig(name="counter", env_id="StepCounter-v0")
CARTPOLE = TaskConfig(name="cartpole", env_id="CartPole-v1")
StepCounter = gymnasium.spec(COUNTER.env_id).entry_point


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


@pytest.mark.parametrize("deterministic", [True, False])
def test_episodes_do_not_depend_on_how_many_are_played_at_once(deterministic, monkeypatch):
    """Every episode has its own seed; sampled actions are those of the first part, then go on."""
    agent = make_agent(COUNTER)

    def played(episodes, at_once):
        # The package has a function of the module's name.
        module = sys.modules["giril_rl.training.scoring"]
        monkeypatch.setattr(module, "EPISODES_AT_ONCE", at_once)
        return evaluate(agent, COUNTER, episodes=episodes, seed=4, deterministic=deterministic)

    whole, parts = played(12, 100), played(12, 5)
    assert parts.episode_length_mean == whole.episode_length_mean
    assert parts.returns[:5] == played(5, 100).returns
    assert len(set(parts.returns)) == 12
    if deterministic:
        assert parts.returns == pytest.approx(whole.returns, rel=1e-6)


def test_no_more_simulators_than_bounded_are_open_at_once(monkeypatch):
    open_now, most = 0, 0
    reset, close = StepCounter.reset, StepCounter.close

    def counted_reset(self, **kwargs):
        nonlocal open_now, most
        if not hasattr(self, "counted"):
            self.counted, open_now = True, open_now + 1
            most = max(most, open_now)
        return reset(self, **kwargs)

    def counted_close(self):
        nonlocal open_now
        open_now -= hasattr(self, "counted")
        close(self)

    monkeypatch.setattr(StepCounter, "reset", counted_reset)
    monkeypatch.setattr(StepCounter, "close", counted_close)
    scores = evaluate(make_agent(COUNTER), COUNTER, episodes=70, seed=0, deterministic=True)
    assert (len(scores.returns), most, open_now) == (70, EPISODES_AT_ONCE, 0)


def test_simulators_are_closed_where_playing_fails(monkeypatch):
    closed = []
    monkeypatch.setattr(StepCounter, "close", lambda self: closed.append(self))

    class Broken:
        def acting(self):
            raise_it = lambda tensordict: tensordict["nothing"]  # noqa: E731
            return raise_it

    with pytest.raises(KeyError):
        evaluate(Broken(), COUNTER, episodes=3, seed=0, deterministic=True)
    assert len(closed) == 3


def test_batch_statistics_are_used_and_left_alone():
    agent = make_agent(COUNTER)
    agent.actor.insert(1, torch.nn.BatchNorm1d(16))
    agent.actor[2].eval()
    alone = [
        evaluate(agent, COUNTER, episodes=count, seed=4, deterministic=True).returns[0]
        for count in (1, 8)
    ]
    assert alone[0] == pytest.approx(alone[1], rel=1e-6)
    assert agent.actor[1].num_batches_tracked == 0
    assert agent.actor[1].training
    assert not agent.actor[2].training


@pytest.mark.slow
def test_a_thousand_episodes_of_pybullet_fit_into_memory():
    """30 MB a simulator would be 30 GB."""
    code = (
        "import resource, torch\n"
        "from giril_rl.config.schema import TaskConfig\n"
        "from giril_rl.envs import make_env\n"
        "from giril_rl.policies import ActorCritic\n"
        "from giril_rl.training.scoring import evaluate\n"
        "task = TaskConfig(name='pendulum', env_id='InvertedPendulumBulletEnv-v0')\n"
        "env = make_env(task, 1, seed=0)\n"
        "agent = ActorCritic(5, env.action_spec, hidden=(16,))\n"
        "evaluate(agent, task, episodes=1000, seed=0, deterministic=False)\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout.split()[-1]) < 1.5 * 2**20  # KiB


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


class NoNumber(StepCounter):
    """Its third step pays NaN."""

    def step(self, action):
        observation, reward, *flags = super().step(action)
        return observation, float("nan") if observation[1] == 3 else reward, *flags


def test_a_return_that_is_no_number_is_no_score():
    gymnasium.register("NoNumber-v0", NoNumber, kwargs={"length": 5}, max_episode_steps=9)
    task = TaskConfig(name="no_number", env_id="NoNumber-v0")
    with pytest.raises(UserError, match="episode 0 is nan: the environment NoNumber-v0 pays"):
        evaluate(make_agent(task), task, episodes=2, seed=0, deterministic=True)
