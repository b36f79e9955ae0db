import math

import pytest
import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import ClipPPOLoss

from giril_rl.errors import UserError
from giril_rl.policies import PixelActorCritic

CLIP, ENTROPY, VALUE = 0.1, 0.01, 0.5


def observe(*batch):
    frames = torch.randint(256, (*batch, 4, 84, 84), dtype=torch.uint8)
    return TensorDict({"observation": frames}, batch)


@pytest.fixture
def agent():
    agent = PixelActorCritic(5)
    with torch.no_grad():
        agent.actor.head.weight.mul_(100)  # Far from uniform.
    return agent


@pytest.fixture
def passes(agent):
    """Appended to at each pass through the trunk."""
    calls = []
    agent.actor.trunk.register_forward_hook(lambda *_: calls.append(1))
    return calls


def by_hand(agent, observation):
    """Logits and value ``(N,)`` of frames ``(N, 4, 84, 84)``, layer by layer."""
    one, two, three, full = (x for x in agent.actor.trunk if isinstance(x, (nn.Conv2d, nn.Linear)))
    x = observation.double() / 255
    for layer, stride in ((one, 4), (two, 2), (three, 1)):
        x = F.conv2d(x, layer.weight.double(), layer.bias.double(), stride=stride).clamp(min=0)
    x = (x.flatten(1) @ full.weight.double().T + full.bias.double()).clamp(min=0)
    logits, value = (
        x @ head.weight.double().T + head.bias.double() for head in (agent.actor.head, agent.critic)
    )
    return logits, value.squeeze(-1)


def test_layers():
    weights = [tuple(p.shape) for p in PixelActorCritic(6).parameters() if p.ndim > 1]
    assert weights == [
        (32, 4, 8, 8),
        (64, 32, 4, 4),
        (32, 64, 3, 3),
        (512, 1568),
        (6, 512),
        (1, 512),
    ]


def test_initialisation_is_orthogonal():
    agent = PixelActorCritic(6)
    gains = [math.sqrt(2)] * 4 + [0.01, 1.0]
    layers = [x for x in agent.modules() if isinstance(x, (nn.Conv2d, nn.Linear))]
    for layer, gain in zip(layers, gains, strict=True):
        values = torch.linalg.svdvals(layer.weight.flatten(1))
        torch.testing.assert_close(values, torch.full_like(values, gain), rtol=1e-4, atol=1e-5)
        assert not layer.bias.any()


def test_distribution_and_value_by_hand(agent, passes):
    data = observe(2, 3)
    distribution, value = agent.distribution_and_value(data["observation"])
    assert len(passes) == 1
    logits, expected = by_hand(agent, data["observation"].flatten(0, 1))
    assert value.shape == (2, 3, 1)
    torch.testing.assert_close(value.flatten().double(), expected, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(
        distribution.log_probabilities.flatten(0, 1).double(),
        logits.log_softmax(-1),
        rtol=1e-4,
        atol=1e-4,
    )


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_acting(agent, passes, batch):
    data = agent.acting()(observe(*batch))
    assert len(passes) == 1
    assert data["action"].shape == data["action_log_prob"].shape == batch
    assert data["action"].dtype == torch.int64
    assert data["state_value"].shape == (*batch, 1)
    assert not data["state_value"].requires_grad
    assert not data["action_log_prob"].requires_grad
    logits, value = by_hand(agent, data["observation"].reshape(-1, 4, 84, 84))
    expected = logits.log_softmax(-1).gather(-1, data["action"].reshape(-1, 1))
    recorded = data["action_log_prob"].reshape(-1, 1).double()
    torch.testing.assert_close(recorded, expected, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(data["state_value"].flatten().double(), value, rtol=1e-4, atol=1e-5)


def test_deterministic_mode_is_the_most_likely_action(agent):
    data, policy = observe(20), agent.acting()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        actions = policy(data.clone())["action"]
    logits, _ = by_hand(agent, data["observation"])
    assert torch.equal(actions, logits.argmax(-1))
    drawn = torch.stack([policy(data.clone())["action"] for _ in range(5)])
    assert (drawn != actions).any()
    data["dealt"] = agent.actor.deal(data["observation"])
    assert torch.equal(agent.actor_for_loss()(data)["action"], actions)


def minibatch(agent, size=30):
    data = agent.acting()(observe(size))
    data["dealt"] = agent.actor.deal(data["observation"])
    data["action_log_prob"] += 0.2 * torch.randn(size)  # some ratios are clipped, some are not
    data["state_value"] += 0.2 * torch.randn(size, 1)
    data["advantage"] = torch.randn(size, 1)
    data["value_target"] = data["state_value"] + 0.5 * torch.randn(size, 1)
    return data


def expected_losses(agent, data):
    """PPO's clipped losses in float64, written out."""
    logits, value = by_hand(agent, data["observation"])
    log_probabilities = logits.log_softmax(-1)
    action, old = data["action"], data["action_log_prob"].double()
    ratio = (log_probabilities[torch.arange(len(action)), action] - old).exp()
    advantage, target, old_value = (
        data[key].squeeze(-1).double() for key in ("advantage", "value_target", "state_value")
    )
    gain = torch.minimum(ratio * advantage, ratio.clamp(1 - CLIP, 1 + CLIP) * advantage)
    entropy = -(log_probabilities.exp() * log_probabilities).sum(-1)
    clipped = old_value + (value - old_value).clamp(-CLIP, CLIP)
    squared = torch.maximum((value - target) ** 2, (clipped - target) ** 2)
    return {
        "loss_objective": -gain.mean(),
        "loss_entropy": -ENTROPY * entropy.mean(),
        "loss_critic": VALUE * squared.mean(),
    }


def test_loss_and_gradients_by_hand_with_one_pass_through_the_trunk(agent, passes):
    data = minibatch(agent)
    loss = ClipPPOLoss(
        agent.actor_for_loss(),
        agent.critic_for_loss(),
        clip_epsilon=CLIP,
        clip_value=True,
        entropy_bonus=True,
        entropy_coeff=ENTROPY,
        critic_coeff=VALUE,
        loss_critic_type="l2",
        normalize_advantage=False,
        functional=False,
    )
    passes.clear()
    needed = {"action", "action_log_prob", "advantage", "value_target", "state_value"}
    losses = loss(data.select(*agent.input_keys, *needed))
    assert len(passes) == 1
    expected = expected_losses(agent, data)
    for name, value in expected.items():
        torch.testing.assert_close(losses[name].double(), value, rtol=1e-3, atol=1e-5)
    assert 0 < losses["clip_fraction"] < 1
    assert 0 < losses["value_clip_fraction"] <= 1
    parameters = list(agent.parameters())
    grads = torch.autograd.grad(sum(losses[name] for name in expected), parameters)
    wanted = torch.autograd.grad(sum(expected.values()), parameters)
    for grad, want in zip(grads, wanted, strict=True):
        assert (grad - want).norm() < 1e-3 * want.norm()


def test_the_minibatch_itself_is_left_as_it_was(agent):
    data = minibatch(agent)
    keys, value = set(data.keys()), data["state_value"].clone()
    loss = ClipPPOLoss(
        agent.actor_for_loss(), agent.critic_for_loss(), clip_value=True, functional=False
    )
    loss(data)
    assert set(data.keys()) == keys
    assert torch.equal(data["state_value"], value)


def test_loss_parameters_are_the_agents_and_each_is_there_once(agent):
    loss = ClipPPOLoss(agent.actor_for_loss(), agent.critic_for_loss(), functional=False)
    assert {id(p) for p in loss.parameters()} == {id(p) for p in agent.parameters()}
    assert len(list(loss.parameters())) == len(list(agent.parameters()))


def test_there_is_nothing_to_normalise(agent):
    before = {k: v.clone() for k, v in agent.state_dict().items()}
    data = observe(2)
    agent.update_normaliser(data["observation"])
    assert all(torch.equal(v, before[k]) for k, v in agent.state_dict().items())
    assert agent.normaliser(data["observation"]) is data["observation"]


def test_other_shapes_are_refused(agent):
    with pytest.raises(UserError, match="84"):
        agent.hidden(torch.zeros(2, 4, 96, 96, dtype=torch.uint8))
