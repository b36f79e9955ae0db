from types import SimpleNamespace

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Categorical, OneHot, Unbounded
from torchrl.envs import GymEnv

from giril_rl.config.schema import PPOConfig, TaskConfig
from giril_rl.envs import make_env
from giril_rl.errors import UserError
from giril_rl.policies import (
    ActorCritic,
    PixelActorCritic,
    agent_for,
    check_actions,
    fits,
    load_agent,
    make_agent,
)
from giril_rl.training.scoring import evaluate

CARTPOLE = TaskConfig(name="cartpole", env_id="CartPole-v1")
CFG = PPOConfig(hidden=[16])


def test_an_agent_follows_from_its_seed_alone():
    env = make_env(CARTPOLE, 2, seed=0)
    state = torch.get_rng_state()
    first = make_agent(env, CFG, seed=0)
    assert torch.equal(torch.get_rng_state(), state)
    torch.manual_seed(55)
    again, other = make_agent(env, CFG, seed=0), make_agent(env, CFG, seed=1)
    assert torch.equal(first.actor[0].weight, again.actor[0].weight)
    assert not torch.equal(first.actor[0].weight, other.actor[0].weight)
    assert first.actor[0].weight.shape == (16, 4)


def test_an_agent_comes_back_with_its_statistics(tmp_path):
    agent = make_agent(make_env(CARTPOLE, 1, seed=0), CFG, seed=3)
    agent.update_normaliser(torch.randn(30, 4))
    agent.save_pretrained(tmp_path / "policy")
    loaded = load_agent(tmp_path, CARTPOLE)
    for name, value in agent.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value), name


def test_a_missing_or_foreign_policy_is_refused(tmp_path):
    with pytest.raises(UserError, match="holds no trained policy"):
        load_agent(tmp_path, CARTPOLE)
    agent = make_agent(make_env(CARTPOLE, 1, seed=0), CFG, seed=0)
    agent.save_pretrained(tmp_path / "policy")
    with pytest.raises(UserError, match="does not fit pendulum"):
        load_agent(tmp_path, TaskConfig(name="pendulum", env_id="Pendulum-v1"))
    with pytest.raises(UserError, match="does not fit mountain_car"):
        load_agent(tmp_path, TaskConfig(name="mountain_car", env_id="MountainCar-v0"))


def test_an_agent_has_the_encoding_of_its_environment():
    integers, one_hot = make_env(CARTPOLE, 2, seed=0), GymEnv("CartPole-v1")
    for env, other in ((integers, one_hot), (one_hot, integers)):
        agent = agent_for(env, hidden=(8,), normalise=True)
        assert fits(agent, env) and not fits(agent, other)
        assert env.rollout(3, agent.acting())["action"].dtype == env.action_spec.dtype
        with pytest.raises(UserError, match="made for actions"):
            check_actions(agent, other)
    with pytest.raises(UserError, match=r"made for actions .*one_hot.* has .*discrete"):
        evaluate(ActorCritic(4, OneHot(2)), CARTPOLE, episodes=1, seed=0, deterministic=True)


def test_agents_of_frames_have_it_as_well():
    frames = Unbounded((2, 4, 84, 84), dtype=torch.uint8)
    integers, one_hot = (
        SimpleNamespace(observation_spec={"observation": frames}, action_spec=spec, batch_dims=1)
        for spec in (Categorical(3, shape=(2,)), OneHot(3, shape=(2, 3)))
    )
    for env, other in ((integers, one_hot), (one_hot, integers)):
        agent = agent_for(env, hidden=(), normalise=True)
        assert fits(agent, env) and not fits(agent, other)
    assert fits(PixelActorCritic(3), integers) and fits(PixelActorCritic(Categorical(3)), integers)
    shown = TensorDict({"observation": torch.zeros(2, 4, 84, 84, dtype=torch.uint8)}, [2])
    assert agent.acting()(shown)["action"].sum(-1).tolist() == [1, 1]
    with pytest.raises(UserError, match="discrete actions"):
        PixelActorCritic(Bounded(-1, 1, shape=(1,)))


def test_actions_of_more_dimensions_are_refused():
    spec = Bounded(-1, 1, shape=(2, 3))
    env = SimpleNamespace(
        observation_spec={"observation": Unbounded(4)}, action_spec=spec, batch_dims=0
    )
    with pytest.raises(UserError, match=r"shape \(2, 3\) .* is not supported"):
        agent_for(env, hidden=(), normalise=True)
