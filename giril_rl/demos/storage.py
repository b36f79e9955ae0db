"""A folder of memory-mapped tensors, read without any way to run code."""

from __future__ import annotations

import errno
import math
import os
import shutil
from collections.abc import Collection
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from giril_rl.errors import UserError
from giril_rl.files.disk import sync
from giril_rl.files.untrusted import check_memory, parse_json, read_text

_DTYPES = ("float32", "int64", "bool")
_PAGE = 4096
_TENSORDICT = "<class 'tensordict._td.TensorDict'>"


def save_tensors(folder: Path, transitions: TensorDict) -> None:
    """Write ``transitions`` with ``TensorDict.memmap`` and wait for the disk.

    Raises:
        OSError: ENOSPC if there is not room for it.
    """
    check_room(folder, transitions)
    transitions.detach().cpu().contiguous().memmap(folder, copy_existing=True)
    for path in sorted(folder.rglob("*"), reverse=True):
        sync(path)


def check_room(folder: Path, transitions: TensorDict, *, more: int = _PAGE) -> None:
    """Refuses to begin where a disk that fills up ends the process without a word.

    A memory map and HDF5 both do that.

    Args:
        folder: what is to be written; it need not be there.
        transitions: what is to be written there.
        more: bytes besides the numbers, for each tensor.

    Raises:
        OSError: ENOSPC if there is not room for it.
    """
    tensors = list(transitions.values(include_nested=True, leaves_only=True))
    needed = sum(x.numel() * x.element_size() + more for x in tensors)
    place = next(parent for parent in folder.absolute().parents if parent.exists())
    room = shutil.disk_usage(place)
    if room.total and room.free < needed:  # Some file systems do not say: 0 of 0.
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))


def load_tensors(folder: Path, dtypes: Collection[str] = _DTYPES) -> TensorDict:
    """Copy a folder of :func:`save_tensors` into memory, after looking at every file of it.

    A memmap is written through to its files, so a copy is what keeps a demonstration as recorded.

    Args:
        folder: what a flat TensorDict, or one with ``next`` in it, was memory-mapped into.
        dtypes: names of torch's dtypes that may be there.

    Raises:
        UserError: for anything that is not a plain tensor of the size that its metadata says.

    Examples:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> _ = TensorDict({"note": "text is not a tensor"}).memmap(folder)
        >>> load_tensors(folder)  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ...
        giril_rl.errors.UserError: ... holds 'note', which is not a plain tensor: ...
    """
    _inspect(folder, dtypes, top=True)
    try:
        return TensorDict.load_memmap(folder, allow_pickle=False).clone()
    except (OSError, RuntimeError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{folder} cannot be read ({error}): record it anew.") from None


def _inspect(folder: Path, dtypes: Collection[str], *, top: bool) -> None:
    try:
        meta = parse_json(read_text(folder / "meta.json"))
    except (OSError, ValueError) as error:
        raise UserError(f"{folder} is damaged ({error}): record it anew.") from None
    if not isinstance(meta, dict) or meta.get("_type") != _TENSORDICT:
        raise UserError(f"{folder} holds something other than a TensorDict: record it anew.")
    if not _is_shape(meta.get("shape")) or meta.get("device") not in ("cpu", "None", None):
        raise UserError(f"{folder} has damaged metadata: restore a copy, or record it anew.")
    expected = {"meta.json"}
    for key, entry in meta.items():
        if key in ("shape", "device", "_type"):
            continue
        if top and key == "next" and entry == {"type": "TensorDict"}:
            expected.add("next")
            _inspect(folder / "next", dtypes, top=False)
        else:
            _inspect_tensor(folder, key, entry, dtypes)
            expected.add(f"{key}.memmap")
    # A stray file may be what an object is unpickled from.
    strays = sorted(path.name for path in folder.iterdir() if path.name not in expected)
    links = sorted(path.name for path in folder.iterdir() if path.is_symlink())
    if links:
        raise UserError(f"{folder} has the link {links[0]!r} in it: copy the file itself there.")
    if strays:
        raise UserError(f"{folder} holds {strays[0]!r}, which is not a tensor: record it anew.")


def _inspect_tensor(folder: Path, key: str, entry: Any, dtypes: Collection[str]) -> None:
    # Keys are the demonstration's own names: letters only, so none is a path.
    if (
        not key.isidentifier()
        or not isinstance(entry, dict)
        or set(entry) != {"device", "shape", "dtype", "is_nested"}
        or entry["dtype"] not in [f"torch.{name}" for name in dtypes]
        or entry["is_nested"] is not False
        or entry["device"] != "cpu"
        or not _is_shape(entry["shape"])
    ):
        raise UserError(f"{folder} holds {key!r}, which is not a plain tensor: record it anew.")
    path = folder / f"{key}.memmap"
    wanted = (
        math.prod(entry["shape"]) * getattr(torch, entry["dtype"].removeprefix("torch.")).itemsize
    )
    found = path.stat().st_size if path.is_file() else None
    if found != wanted and (found is not None or wanted):  # Nothing has no file.
        state = "is missing" if found is None else f"has {found} bytes instead of {wanted}"
        raise UserError(f"{path} {state}: restore a copy, or record the demonstration anew.")
    check_memory(str(path), wanted)  # A sparse file is as large as it likes.


def _is_shape(value: Any) -> bool:
    return isinstance(value, list) and all(type(size) is int and size >= 0 for size in value)
