import json
import math
import os
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest
import torch
from safetensors.torch import save_file

from giril_rl.errors import UserError
from giril_rl.runs.checkpoint import load_state, refusing_misfits, save_state


def same(left, right):
    """Equal in value, type, dtype, shape and bits, all the way down."""
    if isinstance(left, torch.Tensor):
        if left.dtype != right.dtype or left.shape != right.shape:
            return False
        return bytes(left.contiguous().reshape(-1).view(torch.uint8).numpy()) == bytes(
            right.contiguous().reshape(-1).view(torch.uint8).numpy()
        )
    if isinstance(left, dict):
        return (
            isinstance(right, dict)
            and [(type(k), k) for k in left] == [(type(k), k) for k in right]
            and all(same(left[k], right[k]) for k in left)
        )
    if isinstance(left, (list, tuple)):
        return type(left) is type(right) and all(map(same, left, right)) and len(left) == len(right)
    return type(left) is type(right) and repr(left) == repr(right)


@pytest.mark.parametrize(
    "value",
    [
        torch.tensor(1.5),
        torch.tensor([True, False]),
        torch.tensor([0.1, math.nan, -0.0, math.inf], dtype=torch.float64),
        torch.arange(5, dtype=torch.uint8),
        torch.tensor(-(2**62)),
        torch.empty(0, 3),
        torch.arange(12.0).reshape(3, 4).t()[1:],
        torch.tensor(2.0).expand(3, 2),
        torch.tensor([0.1, -2.0, 3.7]).bfloat16(),
    ],
    ids=str,
)
def test_tensor_survives_bit_for_bit(tmp_path, value):
    save_state(tmp_path / "a.safetensors", {"x": value})
    assert same(load_state(tmp_path / "a.safetensors"), {"x": value})


def test_scalars_containers_and_look_alike_keys_survive(tmp_path):
    state = {
        "float": 0.1 + 0.2,
        "whole": 1.0,
        "int": 1,
        "big": 2**100,
        "bool": True,
        "none": None,
        "text": 'a "quoted" é\n',
        "inf": -math.inf,
        "betas": (0.9, 0.999),
        "list": [1, [2.0, None], {}],
        "empty": {},
        0: torch.zeros(1),
        "0": torch.ones(1),
        "a.b": torch.full((1,), 2.0),
        "a": {"b": torch.full((1,), 3.0), "tensor": "not one"},
        "tensor": "0:state.0",
    }
    save_state(tmp_path / "a.safetensors", state)
    assert same(load_state(tmp_path / "a.safetensors"), state)


def test_shared_storage_comes_back_equal_and_apart(tmp_path):
    base = torch.arange(6.0)
    save_state(tmp_path / "a.safetensors", {"all": base, "part": base[2:4], "again": base})
    loaded = load_state(tmp_path / "a.safetensors")
    assert same(loaded, {"all": base, "part": base[2:4], "again": base})
    loaded["all"].zero_()
    assert loaded["part"].tolist() == [2.0, 3.0]


def test_training_continues_as_if_never_stopped(tmp_path):
    def build():
        torch.manual_seed(1)
        module = torch.nn.Sequential(
            torch.nn.Linear(3, 4), torch.nn.BatchNorm1d(4), torch.nn.Linear(4, 1)
        )
        return module, torch.optim.Adam(module.parameters(), lr=3e-4)

    def train(module, optimiser, steps):
        for _ in range(steps):
            optimiser.zero_grad()
            module(torch.randn(8, 3)).square().mean().backward()
            optimiser.step()

    module, optimiser = build()
    train(module, optimiser, 3)
    state = {"module": module.state_dict(), "optimiser": optimiser.state_dict()}
    save_state(tmp_path / "a.safetensors", {**state, "rng": torch.get_rng_state()})
    train(module, optimiser, 3)

    other, other_optimiser = build()
    loaded = load_state(tmp_path / "a.safetensors")
    other.load_state_dict(loaded["module"])
    other_optimiser.load_state_dict(loaded["optimiser"])
    torch.set_rng_state(loaded["rng"])
    train(other, other_optimiser, 3)
    assert same(dict(module.state_dict()), dict(other.state_dict()))


@pytest.mark.parametrize("value", [1j, {1, 2}, {(1,): 2}, b"bytes"], ids=str)
def test_other_values_are_a_programming_error_and_leave_the_old_file(tmp_path, value):
    path = tmp_path / "a.safetensors"
    save_state(path, {"step": 1})
    with pytest.raises(TypeError, match=r"state\.ppo\.x"):
        save_state(path, {"ppo": {"x": value}})
    assert load_state(path) == {"step": 1}
    assert os.listdir(tmp_path) == ["a.safetensors"]


@pytest.mark.parametrize("damage", ["truncate", "flip", "empty", "garbage"])
def test_damaged_file_is_named(tmp_path, damage):
    path = tmp_path / "a.safetensors"
    save_state(path, {"x": torch.randn(100)})
    content = bytearray(path.read_bytes())
    if damage == "truncate":
        content = content[:-10]
    elif damage == "flip":
        content[-10] ^= 1
    elif damage == "empty":
        content = bytearray()
    else:
        content = bytearray(b"\x80\x04 not a checkpoint")
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"a\.safetensors is damaged.*delete the file"):
        load_state(path)


def test_unknown_format_version_and_foreign_file_are_refused(tmp_path):
    path = tmp_path / "a.safetensors"
    save_file({"x": torch.zeros(1)}, path, {"format_version": "2"})
    with pytest.raises(UserError, match="format 2, written by a later giril_rl"):
        load_state(path)
    save_file({"x": torch.zeros(1)}, path)
    with pytest.raises(UserError, match="format 'None', and this giril_rl reads only 1"):
        load_state(path)
    save_file({}, path, {"format_version": "1", "structure": json.dumps({"dict": []})})
    with pytest.raises(UserError, match="damaged"):
        load_state(path)


SAVER = """
import sys, torch
from giril_rl.runs.checkpoint import save_state
torch.set_num_threads(1)
for step in range(10**9):
    save_state(sys.argv[1], {"step": step, "x": torch.full((200_000,), float(step))})
    if step == 0:
        print("ready", flush=True)
"""


def test_a_kill_at_any_moment_leaves_a_whole_checkpoint(tmp_path):
    path = tmp_path / "a.safetensors"
    for round_ in range(2):
        process = subprocess.Popen(
            [sys.executable, "-c", SAVER, str(path)], stdout=subprocess.PIPE, text=True
        )
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        time.sleep(0.05 + 0.0137 * round_)
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stdout.close()
        state = load_state(path)
        assert (state["x"] == state["step"]).all()


@pytest.mark.parametrize("error", [KeyError("step"), RuntimeError("size mismatch")])
def test_a_checkpoint_that_does_not_fit_is_named(error, tmp_path):
    with (
        pytest.raises(UserError, match=r"ppo\.safetensors cannot be restored \(\w+: .*\): if it"),
        refusing_misfits(SimpleNamespace(folder=tmp_path), "ppo"),
    ):
        raise error


def test_too_little_memory_is_not_the_checkpoints_fault(tmp_path):
    with (
        pytest.raises(torch.OutOfMemoryError, match="tried to allocate"),
        refusing_misfits(SimpleNamespace(folder=tmp_path), "ppo"),
    ):
        raise torch.OutOfMemoryError("tried to allocate 2 GiB")
