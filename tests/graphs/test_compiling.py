"""``compile=true``: the same gradient steps, by torch's compiler."""

import copy
import signal
import subprocess
import sys

import pytest
import torch
from compiler import needs_compiler
from frame_losses import CASES
from tensordict import TensorDict
from torch import nn
from torch._dynamo.exc import TorchDynamoException

from giril_rl.errors import RunError
from giril_rl.graphs import TracedGradients, compiled
from giril_rl.rewards import BottleneckLoss

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


@needs_compiler
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


@needs_compiler
def test_another_shape_is_compiled_anew():
    module = Autoencoder()
    twin = copy.deepcopy(module)
    made, plain = gradients_of(module, compile=True), gradients_of(twin)
    for rows in (6, 3, 6):
        inputs = [x[:rows] for x in columns()]
        logs = [gradients.step(inputs) for gradients in (made, plain)]
        torch.testing.assert_close(*logs, rtol=1e-4, atol=1e-5)


@needs_compiler
def test_weights_that_are_loaded_are_used():
    module, other = Autoencoder(), Autoencoder()
    made, plain = gradients_of(module, compile=True), gradients_of(other)
    inputs = columns()
    made.step(inputs)
    module.load_state_dict(other.state_dict())
    logs = [gradients.step(inputs) for gradients in (made, plain)]
    torch.testing.assert_close(*logs, rtol=1e-4, atol=1e-5)


@needs_compiler
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


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_every_loss_on_frames(name, monkeypatch):
    # The compiler draws other numbers.
    monkeypatch.setattr(torch, "randn_like", lambda x: torch.full_like(x, 0.3))
    monkeypatch.setattr(torch, "rand", lambda *shape, device: torch.full(shape, 0.3, device=device))
    gradients, inputs = CASES[name](8)
    losses = [gradients.module.loss, copy.deepcopy(gradients.module.loss)]
    made, plain = (
        TracedGradients(loss, keys=gradients._keys, compile=compile)
        for loss, compile in zip(losses, (True, False), strict=True)
    )
    for step in range(3):
        logs = [made.step(inputs), plain.step(inputs)]
        torch.testing.assert_close(*logs, rtol=1e-3, atol=1e-4)
        largest = max(p.grad.norm() for p in plain.parameters)
        for one, other in zip(made.parameters, plain.parameters, strict=True):
            # Of a bias before batch statistics rounding is all that is left.
            bound = 1e-2 * max(other.grad.norm(), 1e-3 * largest)
            assert (one.grad - other.grad).norm() <= bound
        for loss in losses:
            if isinstance(loss, BottleneckLoss):
                loss.update_beta(torch.tensor(30.0 * (step + 1)))
        torch.testing.assert_close(*(dict(x.named_buffers()) for x in losses), rtol=1e-4, atol=1e-4)


def test_without_a_compiler_there_is_one_sentence(monkeypatch):
    def fails(*_):
        raise TorchDynamoException("No working C++ compiler found\nfar below")

    monkeypatch.setattr(torch, "compile", lambda graph, **_: fails)
    function = compiled(lambda x: (x,), torch.device("cpu"))
    with pytest.raises(RunError, match=r"\(No working C\+\+ compiler found; --traceback shows"):
        function(torch.ones(1))
    assert not signal.pthread_sigmask(signal.SIG_BLOCK, ()) & {signal.SIGINT, signal.SIGTERM}


CTRL_C = """
import multiprocessing.resource_tracker, os, signal, subprocess, sys, torch
from giril_rl.graphs import compiled
from giril_rl.runs.interrupt import Interrupt

def compiler(x):
    multiprocessing.resource_tracker.ensure_running()  # As torch's does.
    program = "import signal; signal.raise_signal(signal.SIGINT); print('compiled', flush=True)"
    subprocess.run([sys.executable, "-c", program])
    os.kill(os.getpid(), signal.SIGINT)
    return (x,)

torch.compile = lambda graph, **_: compiler
with Interrupt() as interrupt:
    compiled(lambda x: (x,), torch.device("cpu"))(torch.ones(1))
print("asked to stop:", interrupt.requested)
"""


def test_ctrl_c_does_not_end_the_compiler_and_is_not_lost():
    # A new process, for torch's compiler starts more of them at its first use.
    run = subprocess.run([sys.executable, "-c", CTRL_C], capture_output=True, text=True)
    assert run.stdout.splitlines() == ["compiled", "asked to stop: True"], run.stderr
