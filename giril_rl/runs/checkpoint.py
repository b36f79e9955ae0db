"""Checkpoints: what a killed run restores, and the file that holds it.

A loop passes one dictionary to :meth:`Run.save <giril_rl.runs.run.Run.save>` whenever it saves, and
gets it back from :meth:`Run.load <giril_rl.runs.run.Run.load>` when the same command runs again.
To continue bit for bit, the dictionary must hold everything that the next step reads:

=====================  ===========================================================================
progress               steps done, seconds so far, inexact resumes, whether training stopped early
                       and the recent returns that decide so
modules                the state of policy, reward and transforms, with their running statistics
optimizer              ``optimizer.state_dict()``
random numbers         :func:`~giril_rl.runs.randomness.rng_state`, and the state of each generator
                       that shuffles minibatches
environments           the simulators' state and the unfinished episodes, where there are any
=====================  ===========================================================================

What a loop must do in return, in this order: put the state back inside
:func:`refusing_misfits`, drop later rows of its phase with :meth:`Run.truncate_metrics
<giril_rl.runs.run.Run.truncate_metrics>`, and save only what is finite (:class:`Finite
<giril_rl.runs.finite_checks.Finite>`). ``tests/trust/test_kill.py`` kills runs at every write and
compares the results. The keys are in ``training/loop.py`` (``_Session.save`` and ``restore``),
``training/fitting.py`` and ``training/cloning.py``.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors import torch as safetensors_torch
from torch import Tensor

from giril_rl.errors import UserError, first_line
from giril_rl.files.disk import write_atomically
from giril_rl.files.untrusted import check_format, parse_json

if TYPE_CHECKING:
    from giril_rl.runs.run import Run

FORMAT_VERSION = "1"


@contextmanager
def refusing_misfits(run: Run, phase: str) -> Iterator[None]:
    """Report a checkpoint that does not fit what it is loaded into.

    Args:
        run: the run that the checkpoint belongs to.
        phase: the checkpoint's name.

    Raises:
        UserError: in place of any error about names, sizes or types inside the ``with``.

    Examples:
        >>> from types import SimpleNamespace
        >>> with refusing_misfits(SimpleNamespace(folder=Path("runs/a")), "ppo"):
        ...     torch.nn.Linear(2, 1).load_state_dict({})
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: runs/a/ppo.safetensors cannot be restored (RuntimeError: ...
    """
    try:
        yield
    except torch.OutOfMemoryError:
        raise  # A RuntimeError, but no reason to delete the checkpoint.
    except (KeyError, IndexError, AttributeError, TypeError, ValueError, RuntimeError) as error:
        reason = first_line(error)
        raise UserError(
            f"{run.folder / phase}.safetensors cannot be restored ({type(error).__name__}: "
            f"{reason}): if it is a checkpoint of another run or task, delete the file to start "
            "that part again, or restore a copy."
        ) from error


def save_state(path: Path | str, state: dict[str, Any]) -> None:
    """Save nested training state as one safetensors file, atomically and without pickle.

    The tensors are the file's tensors; the nesting and all other values are JSON in its metadata.
    ``torch.save`` would pickle everything that is not a tensor, and writes in place.
    ``torchrl.checkpoint`` writes a folder of files and uses ``torch.save`` for optimizer state. A
    checkpoint from a stranger must not be able to run code.

    Tensors keep dtype, shape and every bit. They are stored contiguous, on the CPU and without
    gradient; tensors that shared memory come back separate.

    Args:
        path: the file, such as ``ppo.safetensors``; missing folders are made.
        state: dictionaries (keys str or int), lists and tuples of tensors, numbers, bools,
            strings and None, such as ``module.state_dict()``, ``optimizer.state_dict()`` or
            ``torch.get_rng_state()``.

    Raises:
        TypeError: for any other value or key, with its place in ``state``.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "ppo.safetensors"
        >>> save_state(path, {"step": 3, "lr": 0.1, "adam": {0: torch.tensor(2.0)}})
        >>> load_state(path)
        {'step': 3, 'lr': 0.1, 'adam': {0: tensor(2.)}}
    """
    tensors: dict[str, Tensor] = {}
    structure = json.dumps(_describe(state, "state", tensors))
    metadata = {
        "format_version": FORMAT_VERSION,
        "structure": structure,
        "crc32": _checksum(structure, tensors),
    }
    write_atomically(Path(path), safetensors_torch.save(tensors, metadata))


def load_state(path: Path | str) -> dict[str, Any]:
    """Load what :func:`save_state` saved, with all tensors on the CPU.

    Raises:
        UserError: if the file is missing, damaged or has another format.

    Examples:
        >>> load_state("no/such/file.safetensors")
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: no/such/file.safetensors does not exist: check the path.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError(f"{path} does not exist: check the path.")
    try:
        with safe_open(path, framework="pt", device="cpu") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}
    except (SafetensorError, OSError, ValueError) as error:
        raise _damaged(path, str(error)) from None
    found = str(metadata.get("format_version"))
    check_format(
        int(found) if found.isdecimal() and len(found) < 10 else found,
        [int(FORMAT_VERSION)],
        where=f"{path} has checkpoint format",
        older="finish with the version that wrote it, or delete the file to start that part again",
    )
    try:
        structure = metadata["structure"]
        if metadata["crc32"] != _checksum(structure, tensors):
            raise ValueError("checksum differs")
        state = _rebuild(parse_json(structure), tensors)
        if not isinstance(state, dict):
            raise ValueError("it holds no named values")
        return state
    except (KeyError, ValueError, TypeError, AttributeError, RecursionError) as error:
        raise _damaged(path, str(error)) from None


def _damaged(path: Path, reason: str) -> UserError:
    return UserError(
        f"{path} is damaged or not a giril_rl checkpoint ({reason}): delete the file to start that "
        "part again, or restore a copy."
    )


def _checksum(structure: str, tensors: dict[str, Tensor]) -> str:
    # safetensors detects a wrong length but not a flipped bit.
    total = zlib.crc32(structure.encode())
    for name in sorted(tensors):
        flat = tensors[name].reshape(-1)
        total = zlib.crc32(flat.view(torch.uint8).numpy().data, total)
    return f"{total:08x}"


def _describe(value: Any, name: str, tensors: dict[str, Tensor]) -> Any:
    """``value`` as JSON: scalars as they are, anything else as ``{kind: content}``."""
    if isinstance(value, Tensor):
        # The number separates the keys 0 and "0", and the key "a.b" from nested a, b.
        unique = f"{len(tensors)}:{name}"
        plain = value.detach().cpu().resolve_conj().resolve_neg()
        tensors[unique] = plain.clone(memory_format=torch.contiguous_format)
        return {"tensor": unique}
    if value is None or type(value) in (bool, int, float, str):
        return value
    if isinstance(value, (list, tuple)):
        kind = "tuple" if isinstance(value, tuple) else "list"
        return {kind: [_describe(item, f"{name}.{i}", tensors) for i, item in enumerate(value)]}
    if isinstance(value, dict):
        for key in value:
            if type(key) not in (str, int):
                raise TypeError(f"{name} has the key {key!r}; keys must be str or int.")
        return {"dict": [[k, _describe(item, f"{name}.{k}", tensors)] for k, item in value.items()]}
    raise TypeError(f"{name} is a {type(value).__name__}, which a checkpoint cannot hold.")


def _rebuild(described: Any, tensors: dict[str, Tensor]) -> Any:
    if not isinstance(described, dict):
        return described
    ((kind, content),) = described.items()
    if kind == "tensor":
        return tensors[content]
    if kind == "list":
        return [_rebuild(item, tensors) for item in content]
    if kind == "tuple":
        return tuple(_rebuild(item, tensors) for item in content)
    if kind == "dict":
        return {key: _rebuild(item, tensors) for key, item in content}
    raise ValueError(f"unknown kind {kind!r}")
