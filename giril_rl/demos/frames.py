"""Stacked frames on disk, each distinct one once."""

from __future__ import annotations

import math
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from giril_rl.errors import UserError
from giril_rl.files.disk import sync
from giril_rl.files.untrusted import check_memory

FRAMES_FILE = "frames.npz"

_Array = tuple[np.dtype, tuple[int, ...]]
_BROKEN = (OSError, ValueError, EOFError, KeyError, RuntimeError, zipfile.BadZipFile, zlib.error)


def save_frames(path: Path, observation: Tensor, following: Tensor) -> dict[str, Any]:
    """Write two columns of images as their distinct planes and, for each image, which these are.

    A frame appears in up to eight places of a demonstration: at each place of a stack, of an
    observation and of a next observation. Each plane is stored as the XOR with the one before it,
    in the order in which they first appear: little moves between two frames, so most of that is
    zero. Nothing is lost.

    Args:
        path: the file, ``.npz``.
        observation: uint8 [N, c, h, w].
        following: the next observations, uint8 [N, c, h, w].

    Returns:
        What :func:`load_frames` is to find, as JSON: ``planes``, their number, and ``shape``, that
        of one image.

    Examples:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "frames.npz"
        >>> images = torch.arange(3, dtype=torch.uint8).reshape(3, 1, 1, 1).expand(3, 2, 5, 4)
        >>> declared = save_frames(path, images[:-1], images[1:])
        >>> declared
        {'planes': 3, 'shape': [2, 5, 4]}
        >>> loaded = load_frames(path, declared, length=2)
        >>> bool((loaded[0] == images[:-1]).all() and (loaded[1] == images[1:]).all())
        True
    """
    length, *shape = observation.shape
    columns = (observation.cpu().numpy(), following.cpu().numpy())
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
    """The two columns of images that :func:`save_frames` wrote, after a look at all sizes.

    Nothing is unpickled, and nothing is decompressed before the sizes in the file are those that
    are expected.

    Args:
        path: the file.
        declared: what :func:`save_frames` returned, from a file that anyone may have changed.
        length: N.

    Returns:
        Observations and next observations, uint8 [N, c, h, w] each.

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
            # The planes as read and as they were, and both columns of images.
            check_memory(str(path), 2 * (count + length * shape[0]) * shape[1] * shape[2])
            with np.load(path, allow_pickle=False) as archive:
                change, *index = (archive[name] for name in wanted)
    except _BROKEN as error:
        fault = f"is damaged ({error})"
    if fault is None and any(((part < 0) | (part >= count)).any() for part in index):
        fault = f"refers to planes that are not among its {count}"
    if fault is not None:
        raise UserError(f"{path} {fault}: restore a copy, or record the demonstration anew.")
    planes = torch.from_numpy(np.bitwise_xor.accumulate(change, axis=0))
    observation, following = (planes[torch.from_numpy(part).long()] for part in index)
    return observation, following


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
            member = archive.getinfo(f"{name}.npy")
            with archive.open(member) as file:
                if np.lib.format.read_magic(file) != (1, 0):
                    return f"has {name} in another format"
                held, by_columns, kind = np.lib.format.read_array_header_1_0(file)
                size = file.tell() + math.prod(shape) * dtype.itemsize
            if (held, kind, by_columns) != (shape, dtype, False) or member.file_size != size:
                return f"has {name} of {kind} {list(held)} instead of {dtype} {list(shape)}"
    return None
