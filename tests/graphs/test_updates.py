"""A whole gradient step as one program is the three steps that it stands for."""

import copy

import pytest
import torch
from compiler import needs_compiler
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded, Categorical
from torchrl.objectives import SoftUpdate

from giril_rl.config.schema import SACConfig
from giril_rl.graphs import CompiledUpdate, TracedGradients
from giril_rl.policies.soft_actor_critic import DRAWN, SACAgent
from giril_rl.training.sac import _loss, _tensors

SPECS = {"box": Bounded(-1, 1, shape=(2,)), "discrete": Categorical(3)}


class Learner:
    """SAC's loss with all that a gradient step changes."""

    def __init__(self, kind, compile):
        torch.manual_seed(0)
        agent = SACAgent(4, SPECS[kind], hidden=[8])
        self.agent = agent
        self.loss = _loss(agent, SACConfig())
        keys = ["observation", "action" if agent.discrete else DRAWN]
        keys += [("next", name) for name in ("observation", "reward", "done", "terminated")]
        self.gradients = TracedGradients(self.loss, keys=keys, log=("alpha",), compile=compile)
        self.optimizer = torch.optim.Adam(self.gradients.parameters, lr=0.01, fused=True)
        self.targets = SoftUpdate(self.loss, tau=0.1)

    def plainly(self, inputs):
        log = self.gradients.step(inputs)
        self.optimizer.step()
        self.targets.step()
        return log

    def state(self):
        kept = {name: tensor.detach().clone() for name, tensor in _tensors(self.loss).items()}
        return kept, copy.deepcopy(self.optimizer.state_dict()["state"])


def inputs_of(agent, number, n=16):
    torch.manual_seed(number)
    flag = torch.rand(n, 1) < 0.3
    return [torch.randn(n, 4), agent.random(n), torch.randn(n, 4), torch.randn(n, 1), flag, flag]


@pytest.fixture
def as_it_is(monkeypatch):
    """The graph uncompiled, which draws the same random numbers."""
    monkeypatch.setattr(torch, "compile", lambda graph, **_: graph)


@pytest.mark.parametrize("kind", SPECS)
def test_it_is_gradients_adam_and_targets_one_after_the_other(kind, as_it_is):
    one, other = Learner(kind, compile=True), Learner(kind, compile=False)
    update = CompiledUpdate(one.gradients, one.optimizer, one.targets)
    before = one.state()[0]
    for number in range(5):
        inputs = inputs_of(one.agent, number)
        logs = []
        for step in (update.step, other.plainly):
            torch.manual_seed(100 + number)
            logs.append(step(inputs))
        torch.testing.assert_close(*logs)
    torch.testing.assert_close(one.state(), other.state(), rtol=1e-4, atol=1e-6)
    changed = [name for name, tensor in one.state()[0].items() if not tensor.equal(before[name])]
    assert any(name.startswith("target_") for name in changed) and "log_alpha" in changed


def test_a_saved_optimizer_goes_on(as_it_is):
    """In either form, from the other's."""
    one, other = Learner("box", compile=True), Learner("box", compile=False)
    for number in range(3):
        other.plainly(inputs_of(one.agent, number))
    with torch.no_grad():
        for name, tensor in _tensors(one.loss).items():
            tensor.copy_(_tensors(other.loss)[name])
    one.optimizer.load_state_dict(copy.deepcopy(other.optimizer.state_dict()))
    update = CompiledUpdate(one.gradients, one.optimizer, one.targets)
    for number in range(3, 5):
        for step in (update.step, other.plainly):
            inputs = inputs_of(one.agent, number)
            torch.manual_seed(100 + number)
            step(inputs)
    assert one.state()[1][0]["step"] == 5
    torch.testing.assert_close(one.state(), other.state(), rtol=1e-4, atol=1e-6)


@needs_compiler
@pytest.mark.slow
def test_compiled():
    class Square(nn.Module):
        def __init__(self):
            super().__init__()
            self.weight = nn.Parameter(torch.arange(6.0).reshape(2, 3))

        def forward(self, td):
            return TensorDict({"loss_square": (td["x"] @ self.weight).square().mean()})

    found = []
    for compile in (True, False):
        gradients = TracedGradients(Square(), keys=["x"], compile=compile)
        optimizer = torch.optim.Adam(gradients.parameters, lr=0.1, fused=True)
        update = CompiledUpdate(gradients, optimizer) if compile else None
        for number in range(4):
            torch.manual_seed(number)
            x = torch.randn(5, 2)
            if update is not None:
                update.step([x])
            else:
                gradients.step([x])
                optimizer.step()
        found.append(gradients.parameters[0].detach().clone())
    torch.testing.assert_close(*found)


@pytest.mark.parametrize("changed", [{"weight_decay": 0.1}, {"amsgrad": True}, {"maximize": True}])
def test_an_optimizer_that_does_more_is_refused(changed):
    learner = Learner("box", compile=True)
    optimizer = torch.optim.Adam(learner.gradients.parameters, **changed)
    with pytest.raises(ValueError, match="is not part of the compiled step"):
        CompiledUpdate(learner.gradients, optimizer, learner.targets)


def test_targets_of_a_loss_without_any_are_refused():
    class Square(nn.Module):
        def __init__(self):
            super().__init__()
            self.weight = nn.Parameter(torch.ones(()))

        def forward(self, batch):
            return TensorDict({"loss_square": self.weight.square()})

    gradients = TracedGradients(Square(), keys=["x"], compile=True)
    optimizer = torch.optim.Adam(gradients.parameters)
    with pytest.raises(ValueError, match="has no target networks"):
        CompiledUpdate(gradients, optimizer, Learner("box", compile=True).targets)
