import copy

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded, Categorical
from torchrl.objectives import ClipPPOLoss

from giril_rl.graphs import TracedGradients
from giril_rl.policies import NORMALISED, ActorCritic
from giril_rl.rewards import GenerativeReward, GenerativeRewardLoss
from giril_rl.training.ppo import LOSS_KEYS, RecordableClipPPOLoss

SPECS = {"box": Bounded(-1, 1, shape=(1, 2)), "discrete": Categorical(3, shape=(1,))}
LOG = ("kl_approx", "clip_fraction")


class PPO:
    """ClipPPOLoss as the learner uses it, and batches for it."""

    log = LOG

    def __init__(self, kind):
        self.agent = ActorCritic(4, SPECS[kind], hidden=(16, 16))
        self.keys = (NORMALISED, self.agent.drawn_key, *LOSS_KEYS)
        with torch.no_grad():
            for parameter in self.agent.parameters():
                parameter.add_(0.2 * torch.randn_like(parameter))
        self.loss = RecordableClipPPOLoss(
            self.agent.actor_for_loss(),
            self.agent.critic_for_loss(),
            clip_epsilon=0.1,
            entropy_bonus=True,
            entropy_coeff=0.01,
            critic_coeff=0.5,
            loss_critic_type="l2",
            normalize_advantage=True,
            log_explained_variance=False,
            functional=False,
        )

    def twin(self):
        twin = copy.deepcopy(self.loss)
        twin.__class__ = ClipPPOLoss  # TorchRL's own
        return twin

    def batch(self, size):
        data = self.agent.acting()(TensorDict({"observation": torch.randn(size, 4)}, [size]))
        # Another policy's probabilities, so that the clipping matters.
        data["action_log_prob"] += 0.1 * torch.randn(size)
        data["advantage"] = 3 * torch.randn(size, 1)
        data["value_target"] = 5 * torch.randn(size, 1)
        return data.select(*self.keys)


class Generative:
    """The reward model's loss, whose forward pass draws random numbers."""

    log = ()

    def __init__(self, kind):
        self.kind = kind
        reward = GenerativeReward.for_vectors(
            4, SPECS[kind], hidden=(16, 16), prior="conditional", seed=1
        )
        reward.scaler.fit(torch.randn(50, 4))
        self.loss = GenerativeRewardLoss(reward)
        self.keys = self.loss.in_keys

    def twin(self):
        return copy.deepcopy(self.loss)

    def batch(self, size):
        action = torch.randint(3, (size,)) if self.kind == "discrete" else torch.randn(size, 2)
        observation, following = torch.randn(size, 4), torch.randn(size, 4)
        entries = {"observation": observation, "action": action}
        return TensorDict({**entries, "next": {"observation": following}}, [size])


@pytest.fixture(params=[PPO, Generative])
def case(request):
    return request.param


def eager(loss, batch, log):
    """Losses, logged entries and gradients by an ordinary backward pass."""
    loss.zero_grad()
    out = loss(batch)
    names = [str(key) for key in out.keys() if str(key).startswith("loss_")]
    sum(out[name] for name in names).backward()
    return {name: out[name].detach() for name in (*names, *log)}


def assert_same(found, expected, parameters, eager_parameters):
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert torch.equal(found[name], value), name
        assert not found[name].requires_grad
    for one, other in zip(parameters, eager_parameters, strict=True):
        expected_grad = torch.zeros_like(other) if other.grad is None else other.grad
        assert torch.equal(one.grad, expected_grad)


@pytest.mark.parametrize("kind", SPECS)
def test_bits_are_those_of_an_ordinary_backward_pass_throughout_training(case, kind):
    """Ten steps: the interpreter optimises a recorded graph anew in its first few runs."""
    made = case(kind)
    twin = made.twin()
    traced = TracedGradients(made.loss, keys=made.keys, log=made.log)
    assert len(traced.parameters) == len(list(twin.parameters())) > 8
    pairs = [(made.loss, traced.parameters), (twin, list(twin.parameters()))]
    optimizers = [torch.optim.Adam(ps, lr=0.01, fused=True) for _, ps in pairs]
    seen = []
    for step in range(10):
        batch = made.batch(32)
        torch.manual_seed(step)
        expected = eager(twin, batch, made.log)
        state = torch.get_rng_state()
        torch.manual_seed(step)
        found = traced(batch)
        # As many random numbers were drawn, at the first call as well, when it was recorded.
        assert torch.equal(torch.get_rng_state(), state)
        assert_same(found, expected, traced.parameters, pairs[1][1])
        seen.append(sum(found.values()).item())
        for optimizer in optimizers:
            optimizer.step()
        for one, other in zip(traced.parameters, pairs[1][1], strict=True):
            assert torch.equal(one, other)
    assert len(set(seen)) == 10  # Neither batch nor parameters were recorded as constants.


def test_another_shape_is_recorded_anew(case):
    made = case("box")
    twin = made.twin()
    traced = TracedGradients(made.loss, keys=made.keys, log=made.log)
    for size in (32, 8, 32, 1 if case is Generative else 2, 8):
        batch = made.batch(size)
        torch.manual_seed(size)
        expected = eager(twin, batch, made.log)
        torch.manual_seed(size)
        assert_same(traced(batch), expected, traced.parameters, list(twin.parameters()))


@pytest.mark.parametrize("share", [0.01, 1.1])
def test_clipping_is_torchs(case, share):
    made = case("box")
    twin = made.twin()
    batch = made.batch(32)
    torch.manual_seed(3)
    eager(twin, batch, ())
    parameters = [p for p in twin.parameters() if p.grad is not None]
    norm = torch.nn.utils.get_total_norm([p.grad for p in parameters])
    bound = share * norm.item()
    torch.nn.utils.clip_grad_norm_(parameters, bound)
    traced = TracedGradients(made.loss, keys=made.keys, max_grad_norm=bound)
    torch.manual_seed(3)
    traced(batch)
    for one, other in zip(traced.parameters, twin.parameters(), strict=True):
        expected = torch.zeros_like(other) if other.grad is None else other.grad
        torch.testing.assert_close(one.grad, expected, atol=1e-6, rtol=1e-6)
    clipped = torch.nn.utils.get_total_norm([p.grad for p in traced.parameters])
    assert clipped.item() == pytest.approx(min(bound, norm.item()), rel=1e-4)


def test_only_what_is_trained_gets_a_gradient():
    class Two(nn.Module):
        def __init__(self):
            super().__init__()
            self.used = nn.Parameter(torch.tensor(2.0))
            self.unused = nn.Parameter(torch.tensor(2.0))
            self.frozen = nn.Parameter(torch.tensor(2.0), requires_grad=False)

        def forward(self, batch):
            value = (self.used * self.frozen * batch[NORMALISED]).sum()
            return TensorDict({"loss_a": value, "loss_b": value.square(), "other": value * 100})

    module = Two()
    traced = TracedGradients(module, keys=[NORMALISED])
    out = traced(TensorDict({NORMALISED: torch.ones(3)}, [3]))
    assert out.keys() == {"loss_a", "loss_b"}
    # a = 6 u and b = 36 u^2: 6 + 72 * 2
    assert module.used.grad == 150.0
    assert module.unused.grad == 0.0
    assert module.frozen.grad is None
    assert len(traced.parameters) == 2
