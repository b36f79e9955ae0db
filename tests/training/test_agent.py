import pytest
import torch

from giril_rl.configs import PPOConfig, TaskConfig
from giril_rl.envs import make_env
from giril_rl.errors import UserError
from giril_rl.training.agent import load_agent, make_agent

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
