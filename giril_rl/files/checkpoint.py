"""Nested training state to and from one safetensors file, exactly and without pickle."""

from __future__ import annotations

import json
import zlib
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors import torch as safetensors_torch
from torch import Tensor

from giril_rl.errors import UserError
from giril_rl.files.disk import write_atomically
from giril_rl.files.formats import check_format
from giril_rl.files.untrusted import parse_json

FORMAT_VERSION = "1"


def save_state(path: Path | str, state: dict[str, Any]) -> None:
    """Save nested training state to one safetensors file, replacing the previous one at once.

    The tensors are the file's tensors; the nesting and all other values are JSON in its metadata.
    Why not ``torch.save``: it pickles everything that is not a tensor, and its file is written in
    place. Why not ``torchrl.checkpoint``: it writes a folder of several files, its formats for
    optimiser state (integer keys, tuples, numbers) are ``torch.save`` again, and reading a
    checkpoint that somebody sent must not be able to run code.

    A kill at any moment leaves the previous file. Tensors keep dtype, shape and every bit; they are
    stored contiguous, on the CPU, without gradient, and tensors that shared memory come back apart.

    Args:
        path: the file, such as ``ppo.safetensors``; its folder is made if need be.
        state: dictionaries (keys str or int), lists and tuples of tensors, numbers, bools,
            strings and None, such as ``module.state_dict()``, ``optimizer.state_dict()`` or
            ``torch.get_rng_state()``.

    Raises:
        TypeError: for any other value or key, naming where it is.

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

    Args:
        path: the file.

    Raises:
        UserError: if the file is missing, damaged or of another format.

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
    # safetensors notices a wrong length but not a flipped bit.
    total = zlib.crc32(structure.encode())
    for name in sorted(tensors):
        flat = tensors[name].reshape(-1)
        total = zlib.crc32(flat.view(torch.uint8).numpy().data, total)
    return f"{total:08x}"


def _describe(value: Any, name: str, tensors: dict[str, Tensor]) -> Any:
    """JSON for ``value``: a scalar is itself, all else a one-entry object naming its kind."""
    if isinstance(value, Tensor):
        # The number keeps apart the keys 0 and "0", and the key "a.b" and nested a, b.
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
