import math

import pytest
import torch
from gymnasium import spaces
from tensordict import TensorDict
from torch import nn
from torchrl.data import (
    Binary,
    Bounded,
    Categorical,
    Composite,
    MultiCategorical,
    MultiOneHot,
    OneHot,
    Unbounded,
)
from torchrl.envs import GymEnv, GymWrapper
from torchrl.envs.utils import ExplorationType, set_exploration_type

from giril_rl.errors import UserError
from giril_rl.networks.normalise import RunningNormaliser
from giril_rl.policies import NORMALISED, ActorCritic, PixelActorCritic, load_agent_from

SPECS = {
    "box": Bounded(-1, 1, shape=(8, 2)),
    "unbounded": Unbounded(shape=(8, 2)),
    "scaled": Bounded(
        torch.tensor([1000.0, -0.5]).expand(8, 2), torch.tensor([2000.0, 0.5]).expand(8, 2)
    ),
    "discrete": Categorical(3, shape=(8,)),
    "one_hot": OneHot(3, shape=(8, 3)),
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
    event = (3,) if agent.one_hot else () if agent.discrete else (2,)
    assert data["action"].shape == (*batch, *event)
    assert data["action"].dtype == (torch.int64 if agent.discrete else torch.float32)
    assert set(agent.acting_keys) == set(data.keys()) - {"observation"}
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
    drawn = agent.drawn_key
    again = loss_actor.get_dist(data).log_prob(data[drawn])
    assert torch.equal(again, data["action_log_prob"])
    # In another arrangement, as in a shuffled minibatch.
    flat = data.flatten()[torch.randperm(1280)[:250]]
    ratio = (loss_actor.get_dist(flat).log_prob(flat[drawn]) - flat["action_log_prob"]).exp()
    torch.testing.assert_close(ratio, torch.ones(250), atol=1e-5, rtol=0)
    assert again.requires_grad


def test_recorded_probability_is_that_of_the_raw_observation_by_hand(agent):
    data = agent.acting()(observe(50))
    normaliser = agent.normaliser
    x = (data["observation"].double() - normaliser.mean) / (normaliser.var + 1e-8).sqrt()
    out = agent.actor(x.clamp(-10, 10).float())
    if agent.discrete:
        index = data["action"].argmax(-1) if agent.one_hot else data["action"]
        expected = torch.distributions.Categorical(logits=out).log_prob(index)
    else:
        normal = torch.distributions.Normal(out, agent.log_std.exp())
        expected = normal.log_prob(data[agent.drawn_key]).sum(-1)
    torch.testing.assert_close(data["action_log_prob"], expected, atol=1e-4, rtol=1e-4)


def test_deterministic_mode_is_the_distributions(agent):
    data = observe(30)
    policy = agent.acting()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        first, second = policy(data.clone())["action"], policy(data.clone())["action"]
    assert torch.equal(first, second)
    out = agent.actor(agent.normaliser(data["observation"]))
    if agent.discrete:
        index = first.argmax(-1) if agent.one_hot else first
        assert torch.equal(index, out.argmax(-1))
    else:
        assert torch.equal(first, agent.executed(out))
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


# Actions as the environment takes them


def acted(spec, mean):
    """What a policy writes whose network puts out ``mean``."""
    agent = ActorCritic(1, spec, hidden=(), normalise=False)
    with torch.no_grad():
        agent.actor[-1].bias.copy_(torch.tensor(mean))
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        return agent.acting()(TensorDict({"observation": torch.zeros(1)}, []))


@pytest.mark.parametrize(
    ("low", "high", "mean", "action"),
    [
        ([1000.0], [2000.0], [0.0], [1500.0]),
        ([1000.0], [2000.0], [2.0], [2000.0]),
        ([-0.01], [0.01], [-0.5], [-0.005]),
        ([-1.0], [1.0], [1.75], [1.0]),
        ([-1.0], [1.0], [0.3], [0.3]),
        # A dimension without two bounds keeps its unit and the bound that it has.
        ([0.0], [math.inf], [7.5], [7.5]),
        ([0.0, -math.inf, -2.0], [math.inf, 1.0, 2.0], [-3.0, 4.0, 0.5], [0.0, 1.0, 1.0]),
    ],
)
def test_actions_are_scaled_to_their_bounds_and_clamped(low, high, mean, action):
    data = acted(Bounded(torch.tensor(low), torch.tensor(high)), mean)
    assert torch.equal(data["action"], torch.tensor(action))
    # What was drawn stays as it is, and its density is a standard normal's at its mean.
    assert torch.equal(data["drawn_action"], torch.tensor(mean))
    expected = -len(mean) / 2 * math.log(2 * math.pi)
    assert data["action_log_prob"].item() == pytest.approx(expected)


def test_a_draw_beyond_the_bounds_keeps_its_own_probability():
    agent = ActorCritic(1, Bounded(1000.0, 2000.0, shape=(1,)), hidden=(), normalise=False)
    data = agent.acting()(TensorDict({"observation": torch.zeros(500, 1)}, [500]))
    drawn = data["drawn_action"]
    assert drawn.max() > 2 and data["action"].max() == 2000 and data["action"].min() == 1000
    expected = -0.5 * (drawn.squeeze(-1) ** 2 + math.log(2 * math.pi))
    torch.testing.assert_close(data["action_log_prob"], expected)


def test_actions_without_bounds_are_drawn_and_nothing_more():
    agent = ActorCritic(4, SPECS["unbounded"])
    assert agent.bounds is None and len(agent.acting_keys) == 3
    assert agent.drawn_key == ActorCritic(4, SPECS["discrete"]).drawn_key == "action"


def test_a_saved_policy_keeps_the_bounds_in_an_environment_that_does_not(tmp_path, step_counter):
    counter = step_counter(length=50)
    counter.action_space = spaces.Box(-0.5, 0.5, (1,))
    env = GymWrapper(counter)
    agent = ActorCritic(3, env.action_spec, hidden=())
    policy = load_agent_from(agent.save_pretrained(tmp_path)).acting()
    action = env.rollout(30, policy)["action"]
    assert action.abs().max() == 0.5 > action.abs().min()


def test_one_hot_actions_are_played_as_drawn():
    """The environment takes integers for the first action: one-hot is TorchRL's default."""
    env = GymEnv("CartPole-v1")
    env.set_seed(0)
    agent = ActorCritic(4, env.action_spec, hidden=())
    with torch.no_grad():
        agent.actor[-1].bias.copy_(torch.tensor([0.0, 100.0]))
    data = env.rollout(8, agent.acting())
    assert data["action"].tolist() == [[0, 1]] * len(data)
    assert data["next", "observation"][-1, 1] > 1  # Pushed to the right all the time.


@pytest.mark.parametrize(
    "spec",
    [
        MultiCategorical([2, 3]),
        MultiOneHot([2, 3]),
        Binary(3),
        Bounded(0, 3, shape=(2,), dtype=torch.int64),
        Composite(one=Categorical(2), other=Categorical(2)),
        Bounded(-torch.ones(2, 1), torch.tensor([[1.0], [2.0]]), shape=(2, 1)),
    ],
    ids=lambda spec: type(spec).__name__,
)
def test_actions_of_other_kinds_are_refused(spec):
    with pytest.raises(UserError, match=r"is not supported: give|bounds differ"):
        ActorCritic(4, spec)
    with pytest.raises(UserError):
        PixelActorCritic(spec)


def test_the_only_spec_in_a_composite_is_taken():
    agent = ActorCritic(4, Composite(action=OneHot(3)))
    assert agent.one_hot and agent.made_with["action_spec"] == {"action_spec": "one_hot", "n": 3}
