"""What a checkpoint that cannot be put back is said to be."""

from types import SimpleNamespace

import pytest
import torch

from giril_rl.errors import UserError
from giril_rl.runs.checkpoint import restoring


@pytest.mark.parametrize("error", [KeyError("step"), RuntimeError("size mismatch")])
def test_what_does_not_fit_is_of_another_run(error, tmp_path):
    with (
        pytest.raises(UserError, match=r"ppo\.safetensors cannot be put back \(\w+: .*\): if it"),
        restoring(SimpleNamespace(folder=tmp_path), "ppo"),
    ):
        raise error


def test_too_little_memory_is_not_the_checkpoints_fault(tmp_path):
    with (
        pytest.raises(torch.OutOfMemoryError, match="tried to allocate"),
        restoring(SimpleNamespace(folder=tmp_path), "ppo"),
    ):
        raise torch.OutOfMemoryError("tried to allocate 2 GiB")
