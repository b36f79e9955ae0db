"""Products in bfloat16: how far from float32, in which layers, and that agents learn and resume."""

import pickle

import pytest
import torch
from torch import nn
from torchrl.data import Bounded

from giril_rl.cli.command_line import main
from giril_rl.config.schema import SACConfig, TaskConfig
from giril_rl.envs import make_env
from giril_rl.errors import UserError
from giril_rl.networks.precision import BFloat16Linear
from giril_rl.policies import make_sac_agent
from giril_rl.policies.soft_actor_critic import SACAgent

SPEC = Bounded(-1, 1, shape=(2,))


def twins():
    """Agents of either precision with the same weights."""
    both = {}
    for precision in ("fp32", "bf16"):
        torch.manual_seed(0)
        both[precision] = SACAgent(6, SPEC, hidden=[64, 64, 64], precision=precision)
    return both


def test_the_product_is_of_numbers_rounded_to_bfloat16():
    """By hand: 1 + 2^-9 is rounded to 1, 1 + 2^-7 is not; the bias stays as it is."""
    layer = BFloat16Linear(2, 1)
    with torch.no_grad():
        layer.weight.copy_(torch.tensor([[1.0, 1.0]]))
        layer.bias.fill_(2.0**-12)
    found = layer(torch.tensor([[1 + 2.0**-9, 0.0], [1 + 2.0**-7, 0.0]]))
    assert found.flatten().tolist() == [1 + 2.0**-12, 1 + 2.0**-7 + 2.0**-12]


def test_gradients_are_those_of_float32_to_bfloat16s_precision():
    torch.manual_seed(0)
    layer, x = BFloat16Linear(64, 32), torch.randn(50, 64)
    exact = nn.Linear(64, 32)
    exact.load_state_dict(layer.state_dict())
    gradients = []
    for one in (layer, exact):
        ours = x.clone().requires_grad_()
        one(ours).square().mean().backward()
        gradients.append([ours.grad, one.weight.grad, one.bias.grad])
    for found, expected in zip(*gradients, strict=True):
        assert found.dtype == torch.float32
        assert not torch.equal(found, expected)
        assert (found - expected).abs().max() < 0.02 * expected.abs().max()


def test_the_first_and_the_last_layer_stay_in_float32():
    agent = twins()["bf16"]
    for network in (agent.actor[0], agent.critic().module):
        layers = [type(part) for part in network if isinstance(part, nn.Linear)]
        assert layers == [nn.Linear, BFloat16Linear, BFloat16Linear, nn.Linear]


def test_weights_begin_the_same_and_actions_nearly_so():
    both = twins()
    states = [agent.state_dict() for agent in both.values()]
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])
    x = torch.randn(100, 6)
    exact, rounded = (agent.act(x, greedy=True)[0] for agent in both.values())
    assert 0 < (exact - rounded).abs().max() < 0.01


def test_the_settings_precision_is_the_agents():
    env = make_env(TaskConfig(name="pendulum", env_id="Pendulum-v1"), 1, seed=0)
    for precision in ("fp32", "bf16"):
        agent = make_sac_agent(env, SACConfig(precision=precision), seed=0)
        kinds = {type(part) for part in agent.modules()}
        assert (BFloat16Linear in kinds) == (precision == "bf16")


def test_what_has_no_such_products_is_refused(capsys):
    with pytest.raises(UserError, match="precision='half' is unknown: choose fp32 or bf16"):
        SACAgent(6, SPEC, precision="half")
    assert main(["run", "pwil", "sac.hidden=[64]", "sac.precision=bf16"]) == 2
    assert "sac.hidden=[64] is one: give two or more" in capsys.readouterr().err


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_an_agent_goes_to_other_processes(precision):
    agent = SACAgent(6, SPEC, hidden=[16, 16], precision=precision)
    x = torch.randn(9, 6)
    there = pickle.loads(pickle.dumps(agent))
    assert torch.equal(there.act(x, greedy=True)[0], agent.act(x, greedy=True)[0])
    pickle.loads(pickle.dumps(agent.acting()))


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_a_saved_agent_keeps_its_precision(precision, tmp_path):
    agent = SACAgent(6, SPEC, hidden=[16, 16], precision=precision)
    loaded = SACAgent.from_pretrained(agent.save_pretrained(tmp_path / "p"))
    x = torch.randn(9, 6)
    assert loaded.precision == precision
    assert torch.equal(loaded.act(x, greedy=True)[0], agent.act(x, greedy=True)[0])
