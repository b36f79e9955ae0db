import math

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded, Categorical, Unbounded
from torchrl.envs.utils import ExplorationType, set_exploration_type

from giril_rl.networks.normalise import RunningNormaliser
from giril_rl.networks.policy import NORMALISED, ActorCritic

SPECS = {
    "box": Bounded(-1, 1, shape=(8, 2)),
    "unbounded": Unbounded(shape=(8, 2)),
    "discrete": Categorical(3, shape=(8,)),
}


@pytest.fixture(params=SPECS)
def agent(request):
    torch.manual_seed(0)
    agent = ActorCritic(4, SPECS[request.param], hidden=(16, 12))
    with torch.no_grad():  # As after some training.
        for parameter in agent.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    agent.update_normaliser(5 * torch.randn(100, 4) + 2)
    return agent


def observe(*batch):
    return TensorDict({"observation": 5 * torch.randn(*batch, 4) + 2}, batch)


@pytest.mark.parametrize("batch", [(8,), (8, 5)])
def test_shapes(agent, batch):
    data = agent.acting()(observe(*batch))
    assert data["action"].shape == (batch if agent.discrete else (*batch, 2))
    assert data["action"].dtype == (torch.int64 if agent.discrete else torch.float32)
    assert data["action_log_prob"].shape == batch
    assert data[NORMALISED].shape == (*batch, 4)
    assert not any(value.requires_grad for value in data.values())
    assert agent.critic_for_loss()(data)["state_value"].shape == (*batch, 1)
    assert (agent.log_std is None) == agent.discrete


def test_initial_weights_are_orthogonal_with_their_gains():
    agent = ActorCritic(4, SPECS["box"], hidden=(16, 12))
    assert agent.log_std.tolist() == [0.0, 0.0]  # A standard deviation of 1.
    root = math.sqrt(2)
    for network, gains in ((agent.actor, (root, root, 0.01)), (agent.critic, (root, root, 1.0))):
        layers = [layer for layer in network if isinstance(layer, nn.Linear)]
        for layer, gain in zip(layers, gains, strict=True):
            values = torch.linalg.svdvals(layer.weight)
            torch.testing.assert_close(values, torch.full_like(values, gain))
            assert not layer.bias.any()


def test_the_loss_sees_the_probability_that_was_recorded(agent):
    """So that PPO's ratio is 1 for the very first minibatch."""
    data = agent.acting()(observe(64, 20))
    loss_actor = agent.actor_for_loss()
    again = loss_actor.get_dist(data).log_prob(data["action"])
    assert torch.equal(again, data["action_log_prob"])
    # In another arrangement, as in a shuffled minibatch.
    flat = data.flatten()[torch.randperm(1280)[:250]]
    ratio = (loss_actor.get_dist(flat).log_prob(flat["action"]) - flat["action_log_prob"]).exp()
    torch.testing.assert_close(ratio, torch.ones(250), atol=1e-5, rtol=0)
    assert again.requires_grad


def test_recorded_probability_is_that_of_the_raw_observation_by_hand(agent):
    data = agent.acting()(observe(50))
    normaliser = agent.normaliser
    x = (data["observation"].double() - normaliser.mean) / (normaliser.var + 1e-8).sqrt()
    out = agent.actor(x.clamp(-10, 10).float())
    if agent.discrete:
        expected = torch.distributions.Categorical(logits=out).log_prob(data["action"])
    else:
        normal = torch.distributions.Normal(out, agent.log_std.exp())
        expected = normal.log_prob(data["action"]).sum(-1)
    torch.testing.assert_close(data["action_log_prob"], expected, atol=1e-4, rtol=1e-4)


def test_deterministic_mode_is_the_distributions(agent):
    data = observe(30)
    policy = agent.acting()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        first, second = policy(data.clone())["action"], policy(data.clone())["action"]
    assert torch.equal(first, second)
    out = agent.actor(agent.normaliser(data["observation"]))
    assert torch.equal(first, out.argmax(-1) if agent.discrete else out)
    drawn = torch.stack([policy(data.clone())["action"] for _ in range(5)])
    assert (drawn != first).any()
    normalised = {NORMALISED: agent.normaliser(data["observation"])}
    assert torch.equal(agent.actor_for_loss()(TensorDict(normalised, [30]))["action"], first)


def test_acting_shares_the_agents_parameters_and_learns_no_statistics(agent):
    policy = agent.acting()
    count = agent.normaliser.count.clone()
    data = observe(10)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        before = policy(data.clone())
        with torch.no_grad():
            agent.actor[-1].bias.add_(torch.arange(len(agent.actor[-1].bias)) * 100.0)
        after = policy(data.clone())
    assert not torch.equal(before["action"], after["action"])
    assert torch.equal(agent.normaliser.count, count)
    assert torch.equal(before["observation"], after["observation"])


def test_normalisation_can_be_off():
    agent = ActorCritic(4, SPECS["box"], normalise=False)
    assert not isinstance(agent.normaliser, RunningNormaliser)
    data = agent.acting()(observe(10))
    assert torch.equal(data[NORMALISED], data["observation"])
    agent.update_normaliser(data["observation"])
    assert torch.equal(agent.acting()(data)[NORMALISED], data["observation"])
