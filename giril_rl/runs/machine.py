"""The machine that a run is made on: packages, processor, device and memory allocator.

Imports torch only where it is needed: the command line loads this module at its start.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import platform
import sys
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from giril_rl.errors import UserError

PACKAGES = ("torch", "torchrl", "tensordict", "gymnasium", "pybullet", "ale-py", "giril-rl")
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # From glibc's malloc.h.
_LARGEST_MMAP_THRESHOLD = 32 * 2**20  # The most that glibc accepts.
_KEPT_MEMORY = 2**30
_SET_BY_THE_USER = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES")


def installed_versions() -> dict[str, str | None]:
    """Versions of Python and of the packages that decide a run's numbers; None if not installed.

    Examples:
        >>> sorted(installed_versions())
        ['ale_py', 'giril_rl', 'gymnasium', 'pybullet', 'python', 'tensordict', 'torch', 'torchrl']
    """
    versions: dict[str, str | None] = {"python": ".".join(map(str, sys.version_info[:3]))}
    for name in PACKAGES:
        try:
            versions[name.replace("-", "_")] = version(name)
        except PackageNotFoundError:
            versions[name.replace("-", "_")] = None
    return versions


def processor() -> str:
    """The name of the CPU.

    Examples:
        >>> bool(processor())
        True
    """
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine() or "unknown"


def check_device(device: str) -> None:
    """Refuse a device that is not there, before anything is made.

    Raises:
        UserError: for ``"cuda"`` if torch finds no GPU.

    Examples:
        >>> check_device("cpu")
    """
    if device == "cuda":
        import torch

        if not torch.cuda.is_available():
            raise UserError(
                "device=cuda, and torch sees no GPU here: leave device=cpu, or install a CUDA "
                "build of torch."
            )


def keep_freed_memory(environment: Mapping[str, str] = os.environ) -> bool:
    """Tell glibc to keep up to 1 GiB of freed memory for this process.

    By default glibc returns every freed tensor of some megabytes to the system, and the next one is
    mapped and zeroed page by page. That is about a quarter of the time of PPO's update of a pixel
    policy on a CPU. The command line calls this once before a run; it affects the whole process.

    Args:
        environment: if it has one of glibc's own settings, nothing is changed.

    Returns:
        Whether it was done; False for another C library.

    Examples:
        >>> keep_freed_memory({"MALLOC_TRIM_THRESHOLD_": "0"})
        False
    """
    if any(name in environment for name in _SET_BY_THE_USER):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):
        return False
    done = mallopt(_MMAP_THRESHOLD, _LARGEST_MMAP_THRESHOLD)
    return bool(done) and bool(mallopt(_TRIM_THRESHOLD, _KEPT_MEMORY))
