"""``compile=true``: the same gradient steps, by torch's compiler."""

import copy
import signal
import subprocess
import sys

import pytest
import torch
from frame_losses import CASES
from tensordict import TensorDict
from torch import nn
from torch._dynamo.exc import TorchDynamoException

from giril_rl.errors import RunError
from giril_rl.training.compiled import compiled
from giril_rl.training.interrupt import Interrupt
from giril_rl.training.traced import TracedGradients

ROWS = 6


class Autoencoder(nn.Module):
    """Has what the losses on frames have: convolutions, batch statistics and random numbers.

    The compiler draws other numbers than torch does, so that only without is there a comparison.
    """

    def __init__(self, noise=0.0):
        super().__init__()
        self.noise = noise
        self.conv = nn.Conv2d(2, 3, 3, stride=2, bias=False)  # The statistics take one away.
        self.norm = nn.BatchNorm2d(3)
        self.up = nn.ConvTranspose2d(3, 2, 3, stride=2)

    def forward(self, batch):
        code = self.norm(self.conv(batch["x"].float() / 255))
        if self.noise:
            code = code + self.noise * torch.randn_like(code)
        predicted = self.up(code)
        error = (predicted - batch["y"]).square().mean()
        return TensorDict({"loss_error": error, "code": code.detach().mean()})


def columns():
    return [torch.randint(256, (ROWS, 2, 9, 9), dtype=torch.uint8), torch.randn(ROWS, 2, 9, 9)]


def gradients_of(module, **settings):
    return TracedGradients(module, keys=["x", "y"], log=["code"], **settings)


@pytest.fixture(autouse=True)
def seeded():
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield


@pytest.mark.parametrize("bound", [None, 0.1])
def test_ten_steps_are_those_without_it(bound):
    one = Autoencoder()
    other = copy.deepcopy(one)
    pairs = [
        gradients_of(module, max_grad_norm=bound, compile=compile)
        for module, compile in ((one, True), (other, False))
    ]
    optimizers = [torch.optim.Adam(g.parameters, lr=0.01, fused=True) for g in pairs]
    seen = []
    for _ in range(10):
        inputs, logs = columns(), []
        for gradients, optimizer in zip(pairs, optimizers, strict=True):
            logs.append(gradients.step(inputs))
            optimizer.step()
        torch.testing.assert_close(*logs, rtol=1e-4, atol=1e-5)
        seen.append(logs[0]["loss_error"].item())
        torch.testing.assert_close(one.state_dict(), other.state_dict(), rtol=1e-3, atol=1e-4)
    assert one.norm.num_batches_tracked == 10
    assert len(set(seen)) == 10


def test_another_shape_is_compiled_anew():
    module = Autoencoder()
    twin = copy.deepcopy(module)
    made, plain = gradients_of(module, compile=True), gradients_of(twin)
    for rows in (6, 3, 6):
        inputs = [x[:rows] for x in columns()]
        logs = [gradients.step(inputs) for gradients in (made, plain)]
        torch.testing.assert_close(*logs, rtol=1e-4, atol=1e-5)


def test_weights_that_are_loaded_are_used():
    module, other = Autoencoder(), Autoencoder()
    made, plain = gradients_of(module, compile=True), gradients_of(other)
    inputs = columns()
    made.step(inputs)
    module.load_state_dict(other.state_dict())
    logs = [gradients.step(inputs) for gradients in (made, plain)]
    torch.testing.assert_close(*logs, rtol=1e-4, atol=1e-5)


def test_random_numbers_follow_the_seed():
    made = gradients_of(Autoencoder(noise=1.0), compile=True)
    inputs = columns()
    torch.manual_seed(0)
    state = torch.get_rng_state()
    first = made.step(inputs)["loss_error"]  # When it is recorded and compiled.
    drawn = torch.get_rng_state()
    second = made.step(inputs)["loss_error"]
    assert not torch.equal(drawn, state)
    assert second != first
    for start, expected in ((state, first), (drawn, second)):
        torch.set_rng_state(start)
        assert made.step(inputs)["loss_error"] == expected


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_every_loss_on_frames(name):
    gradients, inputs = CASES[name]()
    modules = [gradients._loss.loss, copy.deepcopy(gradients._loss.loss)]
    made, plain = (
        TracedGradients(module, keys=gradients._keys, compile=compile)
        for module, compile in zip(modules, (True, False), strict=True)
    )
    noisy = name in ("giril", "vail", "gail with a penalty")
    for _ in range(2):
        logs = [made.step(inputs), plain.step(inputs)]
        torch.testing.assert_close(*logs, rtol=0.5 if noisy else 1e-3, atol=1e-4)
    if not noisy:
        largest = max(p.grad.norm() for p in plain.parameters)
        for one, other in zip(made.parameters, plain.parameters, strict=True):
            # Of a bias before batch statistics rounding is all that is left.
            bound = 1e-3 * max(other.grad.norm(), 1e-3 * largest)
            assert (one.grad - other.grad).norm() <= bound


def replaced(monkeypatch, call):
    """``compiled`` with something else in place of torch's compiler."""
    monkeypatch.setattr(torch, "compile", lambda graph, **_: call)
    return compiled(lambda x: (x,), torch.device("cpu"))


def test_without_a_compiler_there_is_one_sentence(monkeypatch):
    def fails(*_):
        raise TorchDynamoException("No working C++ compiler found\nfar below")

    function = replaced(monkeypatch, fails)
    with pytest.raises(RunError, match=r"\(No working C\+\+ compiler found\): leave compile=false"):
        function(torch.ones(1))
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


def test_ctrl_c_reaches_neither_the_compiler_nor_is_it_lost(monkeypatch):
    seen = []

    def compiles(x):
        if not seen:
            signal.raise_signal(signal.SIGINT)  # Before it starts: a process inherits the mask.
            code = "import signal; signal.raise_signal(signal.SIGINT); print('done')"
            started = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
            seen.append((interrupt.requested, started.stdout.strip()))
        return (x,)

    function = replaced(monkeypatch, compiles)
    with Interrupt() as interrupt:
        function(torch.ones(1))
        assert seen == [(False, "done")]
        assert interrupt.requested
        function(torch.ones(1))
