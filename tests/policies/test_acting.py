import copy

import pytest
import torch
from compiler import needs_compiler
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded, Categorical

from giril_rl.policies import (
    ActingPolicy,
    ActorCritic,
    PixelActorCritic,
    RecordedActing,
    collecting,
)

SPECS = {"box": Bounded(-1, 1, shape=(8, 2)), "discrete": Categorical(3, shape=(8,))}


@pytest.fixture(params=[("box", True), ("box", False), ("discrete", True)])
def agent(request):
    kind, normalise = request.param
    return ActorCritic(4, SPECS[kind], hidden=(16, 12), normalise=normalise)


def change_in_place(agent):
    with torch.no_grad():
        for parameter in agent.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    agent.update_normaliser(5 * torch.randn(100, 4) + 2)


def act(policy, observation, seed):
    torch.manual_seed(seed)
    return policy(TensorDict({"observation": observation}, [len(observation)]))


def test_it_acts_as_the_acting_policy_does_bit_for_bit(agent):
    recorded, plain = RecordedActing(agent), agent.acting()
    assert type(plain) is ActingPolicy
    for seed in range(3):
        for size in (8, 5):  # Another number of environments as well.
            observation = 5 * torch.randn(size, 4) + 2
            expected = act(plain, observation, seed)
            actual = act(recorded, observation, seed)
            assert sorted(actual.keys()) == sorted(expected.keys())
            assert all(torch.equal(actual[key], expected[key]) for key in expected.keys())
            assert actual["action"].dtype == expected["action"].dtype
            assert not any(value.requires_grad for value in actual.values())
        change_in_place(agent)


def test_each_call_draws_anew_and_into_new_tensors(agent):
    policy = RecordedActing(agent)
    acted = [policy(TensorDict({"observation": torch.zeros(8, 4)}, [8])) for _ in range(20)]
    assert len({tuple(x["action"].flatten().tolist()) for x in acted}) > 1
    before = acted[0].clone()
    act(policy, -torch.ones(8, 4), 1)
    assert all(torch.equal(acted[0][key], before[key]) for key in before.keys())


def test_a_state_dict_loaded_later_is_acted_on(agent):
    policy = RecordedActing(agent)
    act(policy, torch.ones(8, 4), 0)
    state = {key: value.clone() for key, value in agent.state_dict().items()}
    expected = act(policy, torch.ones(8, 4), 0)
    change_in_place(agent)
    assert not torch.equal(
        act(policy, torch.ones(8, 4), 0)["action_log_prob"], expected["action_log_prob"]
    )
    agent.load_state_dict(state)
    assert torch.equal(
        act(policy, torch.ones(8, 4), 0)["action_log_prob"], expected["action_log_prob"]
    )


def test_networks_of_pixels_are_called_as_they_are_unless_compiled():
    assert not isinstance(collecting(PixelActorCritic(3)), RecordedActing)
    assert isinstance(collecting(PixelActorCritic(3), compile=True), RecordedActing)
    assert isinstance(collecting(ActorCritic(4, SPECS["box"])), RecordedActing)


@needs_compiler
def test_compiled_it_acts_by_the_same_probabilities_and_values():
    agent = PixelActorCritic(3)
    with torch.no_grad():
        agent.actor.head.weight.mul_(100)  # Far from uniform.
    policy = RecordedActing(agent, compile=True)
    frames = torch.randint(256, (4, 4, 84, 84), dtype=torch.uint8)
    seen = set()
    for seed in range(30):
        if seed == 20:
            with torch.no_grad():
                agent.actor.head.bias.copy_(torch.tensor([0.0, 2.0, 0.0]))
        acted = act(policy, frames, seed)
        distribution, value = agent.distribution_and_value(frames)
        expected = distribution.log_prob(acted["action"])
        torch.testing.assert_close(acted["action_log_prob"], expected, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(acted["state_value"], value, rtol=1e-4, atol=1e-5)
        seen.add(tuple(acted["action"].tolist()))
    assert len(seen) > 5
    assert torch.equal(act(policy, frames, 7)["action"], act(policy, frames, 7)["action"])


@pytest.mark.parametrize("layer", [nn.LayerNorm(16), nn.BatchNorm1d(16), nn.Dropout(0.5)])
def test_layers_with_a_mode_act_in_either(layer):
    agent = ActorCritic(4, SPECS["box"], hidden=(16,))
    agent.actor.insert(1, layer)
    twin = copy.deepcopy(agent)
    recorded = RecordedActing(agent)
    for step in range(4):
        if step == 2:
            agent.eval()
            twin.eval()
        observation = TensorDict({"observation": torch.randn(8, 4)}, [8])
        actions = []
        for policy in (recorded, twin.acting()):
            torch.manual_seed(step)
            actions.append(policy(observation.clone())["action"])
        assert torch.equal(*actions)
        for buffer, other in zip(agent.buffers(), twin.buffers(), strict=True):
            assert torch.equal(buffer, other)
