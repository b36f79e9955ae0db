"""A demonstration's tensors on disk, read without any way to run code.

Tensors lie in a TensorDict memmap. Images lie in ``frames.npz`` instead, each distinct frame once.
"""

from __future__ import annotations

import errno
import math
import os
import shutil
import zipfile
import zlib
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from giril_rl.errors import UserError
from giril_rl.files.disk import sync
from giril_rl.files.untrusted import check_memory, parse_json, read_text

FRAMES_FILE = "frames.npz"
BROKEN = (OSError, ValueError, EOFError, KeyError, RuntimeError, zipfile.BadZipFile, zlib.error)
"""What reading a damaged ``.npz`` file may raise."""
MOST_PACKED = 1100
"""Deflate compresses at most 1032 to 1: a file that claims more lies about its size."""

_DTYPES = ("float32", "int64", "bool")
_PAGE = 4096
_TENSORDICT = "<class 'tensordict._td.TensorDict'>"
_Array = tuple[np.dtype, tuple[int, ...]]


def save_tensors(folder: Path, transitions: TensorDict) -> None:
    """Writes ``transitions`` with ``TensorDict.memmap`` and waits for the disk."""
    check_room(folder, transitions)
    transitions.detach().cpu().contiguous().memmap(folder, copy_existing=True)
    for path in sorted(folder.rglob("*"), reverse=True):
        sync(path)


def check_room(folder: Path, transitions: TensorDict, *, more: int = _PAGE) -> None:
    """Refuses to begin if the disk is too small: memory maps and HDF5 crash on a full disk.

    Args:
        folder: where to write; it need not exist.
        transitions: what to write.
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
    """Copies a folder of :func:`save_tensors` into memory, after checking every file in it.

    It copies because changes to a memmap would change its files.

    Args:
        folder: the memmap of a flat TensorDict, or of one with ``next`` in it.
        dtypes: names of the torch dtypes that are allowed.

    Raises:
        UserError: for anything that is not a plain tensor of the size that its metadata says.
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
    # A stray file may hold a pickled object.
    strays = sorted(path.name for path in folder.iterdir() if path.name not in expected)
    links = sorted(path.name for path in folder.iterdir() if path.is_symlink())
    if links:
        raise UserError(f"{folder} has the link {links[0]!r} in it: copy the file itself there.")
    if strays:
        raise UserError(f"{folder} holds {strays[0]!r}, which is not a tensor: record it anew.")


def _inspect_tensor(folder: Path, key: str, entry: Any, dtypes: Collection[str]) -> None:
    # Keys must be identifiers, so that none is a path.
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
    if found != wanted and (found is not None or wanted):  # An empty tensor has no file.
        state = "is missing" if found is None else f"has {found} bytes instead of {wanted}"
        raise UserError(f"{path} {state}: restore a copy, or record the demonstration anew.")
    check_memory(str(path), wanted)  # A sparse file takes no room on the disk.


def _is_shape(value: Any) -> bool:
    return isinstance(value, list) and all(type(size) is int and size >= 0 for size in value)


def save_frames(path: Path, observation: Tensor, next_observation: Tensor) -> dict[str, Any]:
    """Writes two columns of images, uint8 [N, c, h, w], as distinct planes and their indices.

    With stacked frames, a plane appears in up to eight places: four in observations, four in next
    observations. Planes are stored in order of first appearance, each as the XOR with the one
    before, which is mostly zero as little moves between two frames. Nothing is lost.

    Returns:
        What :func:`load_frames` must find, as JSON: ``planes``, their number, and ``shape`` of one
        image.
    """
    length, *shape = observation.shape
    columns = (observation.cpu().numpy(), next_observation.cpu().numpy())
    index = np.empty((2, length, shape[0]), dtype=np.int32)
    known: dict[bytes, int] = {}
    for row in range(length):
        for which, column in enumerate(columns):
            for place, plane in enumerate(column[row]):
                index[which, row, place] = known.setdefault(plane.tobytes(), len(known))
    planes = np.frombuffer(b"".join(known), dtype=np.uint8).reshape(-1, *shape[1:])
    change = planes.copy()
    change[1:] ^= planes[:-1]
    np.savez_compressed(path, planes=change, observation=index[0], next_observation=index[1])
    sync(path)
    return {"planes": len(planes), "shape": shape}


def load_frames(path: Path, declared: Any, length: int) -> tuple[Tensor, Tensor]:
    """The two columns of images, uint8 [N, c, h, w], that :func:`save_frames` wrote.

    Nothing is unpickled, and nothing is decompressed before its size is known to be right.

    Raises:
        UserError: if the file is missing, damaged, or holds anything else.
    """
    count, shape = _sizes(path, declared)
    wanted: dict[str, _Array] = {
        "planes": (np.dtype(np.uint8), (count, *shape[1:])),
        "observation": (np.dtype(np.int32), (length, shape[0])),
        "next_observation": (np.dtype(np.int32), (length, shape[0])),
    }
    if not path.is_file():
        raise UserError(f"{path} is missing: restore a copy, or record the demonstration anew.")
    try:
        fault = _fault(path, wanted)
        if fault is None:
            # The planes before and after decoding, and both columns of images.
            check_memory(str(path), 2 * (count + length * shape[0]) * shape[1] * shape[2])
            with np.load(path, allow_pickle=False) as archive:
                change, *index = (archive[name] for name in wanted)
    except BROKEN as error:
        fault = f"is damaged ({error})"
    if fault is None and any(((part < 0) | (part >= count)).any() for part in index):
        fault = f"refers to planes that are not among its {count}"
    if fault is not None:
        raise UserError(f"{path} {fault}: restore a copy, or record the demonstration anew.")
    planes = torch.from_numpy(np.bitwise_xor.accumulate(change, axis=0))
    observation, next_observation = (planes[torch.from_numpy(part).long()] for part in index)
    return observation, next_observation


def _sizes(path: Path, declared: Any) -> tuple[int, tuple[int, int, int]]:
    if isinstance(declared, dict) and set(declared) == {"planes", "shape"}:
        count, shape = declared["planes"], declared["shape"]
        sizes = [count, *shape] if isinstance(shape, list) else []
        if len(sizes) == 4 and all(type(size) is int and size > 0 for size in sizes):
            return count, (shape[0], shape[1], shape[2])
    raise UserError(
        f"{path.parent} does not say what {path.name} holds (frames: {declared!r} in its card): "
        "restore a copy, or record the demonstration anew."
    )


def _fault(path: Path, wanted: dict[str, _Array]) -> str | None:
    """What the headers in ``path`` say that is not ``wanted``, if anything."""
    with zipfile.ZipFile(path) as archive:
        found = sorted(member.filename for member in archive.infolist())
        if found != sorted(f"{name}.npy" for name in wanted):
            return f"holds {', '.join(found) or 'nothing'} instead of {', '.join(wanted)}"
        for name, (dtype, shape) in wanted.items():
            held, kind, by_columns, size = npy_header(archive, name)
            right = (held, kind, by_columns) == (shape, dtype, False)
            if not right or archive.getinfo(f"{name}.npy").file_size != size:
                return f"has {name} of {kind} {list(held)} instead of {dtype} {list(shape)}"
    return None


def npy_header(archive: zipfile.ZipFile, name: str) -> tuple[tuple[int, ...], np.dtype, bool, int]:
    """Shape, dtype, column-major order and bytes that an array in an ``.npz`` file claims."""
    with archive.open(f"{name}.npy") as file:
        version = np.lib.format.read_magic(file)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"{name} is in another format")
        first = version == (1, 0)
        read = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
        shape, by_columns, dtype = read(file)
        return shape, dtype, by_columns, file.tell() + math.prod(shape) * dtype.itemsize
