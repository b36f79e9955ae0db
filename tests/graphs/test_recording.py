"""Gradient steps of bodies that users bring: right for every layer, recorded or not."""

import copy
import random
import warnings

import pytest
import torch
import torch.nn.functional as F
from tensordict import TensorDict
from torch import nn
from torch.nn.utils.parametrizations import spectral_norm

from giril_rl.graphs import TracedGradients


class Loss(nn.Module):
    def __init__(self, body, alpha=1.0):
        super().__init__()
        self.body, self.alpha = body, alpha

    def forward(self, batch):
        error = (self.body(batch["x"]) - batch["y"]).square().mean()
        return TensorDict({"loss_error": self.alpha * error})


class Own(nn.Module):
    """A linear layer and something that a recording might hold fast."""

    def __init__(self):
        super().__init__()
        self.linear = nn.Linear(16, 3)
        self.kernel = nn.Parameter(torch.randn(1, 1, 3, 3))
        self.register_buffer("calls", torch.zeros(()))
        self.count = 0

    def forward(self, x):
        return self.own(x, self.linear(x))


def own(function):
    return lambda: type(function.__name__, (Own,), {"own": function})()


def functional_convolution(self, x, out):
    return out + F.conv2d(x.view(-1, 1, 4, 4), self.kernel).mean((1, 2, 3)).unsqueeze(-1)


def buffer_in_place(self, x, out):
    self.calls.add_(1)
    return out * self.calls


def buffer_replaced(self, x, out):
    self.calls = self.calls + 1
    return out * self.calls


def branch_on_the_batch(self, x, out):
    return out if x.mean() > 0 else -out


def branch_on_a_buffer(self, x, out):
    self.calls.add_(1)
    return out if self.calls < 3 else 2 * out


def rows_by_a_mask(self, x, out):
    return out[out > 0].mean()


def counts_in_python(self, x, out):
    self.count += 1
    return out * self.count


def pythons_random_numbers(self, x, out):
    return out if random.random() < 0.5 else -out


def body(*layers):
    return lambda: nn.Sequential(nn.Linear(16, 8), *layers, nn.Linear(8, 3))


RECORDED = {
    "layer norm": body(nn.LayerNorm(8)),
    "batch norm": body(nn.BatchNorm1d(8)),
    "group norm": body(nn.GroupNorm(2, 8)),
    "spectral norm": body(spectral_norm(nn.Linear(8, 8))),
    "dropout": body(nn.Dropout(0.3)),
    "conv1d": body(nn.Unflatten(1, (2, 4)), nn.Conv1d(2, 2, 3, padding=1), nn.Flatten()),
    "conv3d": body(nn.Unflatten(1, (1, 2, 2, 2)), nn.Conv3d(1, 8, 2), nn.Flatten()),
    "functional": own(functional_convolution),
    "buffer in place": own(buffer_in_place),
}
NOT_RECORDED = {
    "momentum of the count": body(nn.BatchNorm1d(8, momentum=None)),
    **{
        function.__name__: own(function)
        for function in (
            buffer_replaced,
            branch_on_the_batch,
            branch_on_a_buffer,
            rows_by_a_mask,
            counts_in_python,
            pythons_random_numbers,
        )
    },
}


def eager(loss, batch):
    loss.zero_grad()
    value = loss(batch)["loss_error"]
    value.backward()
    return value.detach()


def assert_as_eager(loss, *, change):
    """Six steps, of which the last two are after ``change``."""
    twin = copy.deepcopy(loss)
    gradients = TracedGradients(loss, keys=["x", "y"])
    for step in range(6):
        if step == 4:
            for module in (loss, twin):
                change(module)
        size = 5 if step == 3 else 8
        shift = 1.0 if step % 2 else -1.0
        batch = TensorDict({"x": torch.randn(size, 16) + shift, "y": torch.randn(size, 3)}, [size])
        found = []
        for call in (lambda: eager(twin, batch), lambda: gradients(batch)["loss_error"]):  # noqa: B023
            torch.manual_seed(step)
            random.seed(step)
            found.append((call(), torch.get_rng_state(), random.random()))
        (value, torchs, pythons), (own_value, own_torchs, own_pythons) = found
        assert torch.equal(value, own_value)
        assert torch.equal(torchs, own_torchs)
        assert pythons == own_pythons
        for parameter, other in zip(gradients.parameters, twin.parameters(), strict=True):
            expected = torch.zeros_like(other) if other.grad is None else other.grad
            assert torch.equal(parameter.grad, expected)
        for (name, buffer), other in zip(loss.named_buffers(), twin.buffers(), strict=True):
            assert torch.equal(buffer, other), name


@pytest.mark.parametrize("name", RECORDED)
def test_layers_that_are_recorded(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert_as_eager(Loss(RECORDED[name]()), change=nn.Module.eval)


@pytest.mark.parametrize("name", NOT_RECORDED)
def test_what_no_graph_can_do_runs_as_it_is_and_says_so_once(name):
    with pytest.warns(UserWarning, match="cannot be recorded") as said:
        assert_as_eager(Loss(NOT_RECORDED[name]()), change=nn.Module.eval)
    assert len([warning for warning in said if "recorded" in str(warning.message)]) == 1


@pytest.mark.parametrize("name", ["dropout", "batch norm"])
def test_without_torchscript_the_bits_are_the_same(name, monkeypatch):
    monkeypatch.delattr(torch.jit, "trace")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert_as_eager(Loss(RECORDED[name]()), change=nn.Module.eval)


def test_an_annealed_coefficient_is_heeded():
    def anneal(loss):
        loss.alpha = 0.25

    assert_as_eager(Loss(body()()), change=anneal)


def test_endless_kinds_of_batches_are_not_all_kept(monkeypatch):
    monkeypatch.setattr("giril_rl.graphs.recording._MOST_GRAPHS", 2)
    with pytest.warns(UserWarning, match="more than 2 kinds"):
        assert_as_eager(Loss(body()()), change=nn.Module.eval)
