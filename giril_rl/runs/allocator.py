"""Keeping freed memory for the next tensor, where the C library would give it back."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Mapping

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # glibc's malloc.h
_LARGEST = 32 * 2**20  # The most that glibc takes for the second.
_KEPT = 2**30
_SET_BY_THE_USER = ("MALLOC_TRIM_THRESHOLD_", "MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES")


def keep_freed_memory(environment: Mapping[str, str] = os.environ) -> bool:
    """Tells glibc to keep up to a GiB of freed memory, for this process.

    As it comes, glibc gives a tensor of some megabytes back to the system when it is freed, and the
    next one of its size is mapped and zeroed anew, page by page: about a quarter of the time that
    PPO's update of a pixel policy takes on a CPU. The command line calls this once before a run;
    in a program of your own call it yourself if you like, it is about the whole process.

    Args:
        environment: where it is seen whether the user has set this already, and is left alone.

    Returns:
        Whether it was done: not where the C library is another.

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
    return bool(mallopt(_MMAP_THRESHOLD, _LARGEST)) and bool(mallopt(_TRIM_THRESHOLD, _KEPT))
