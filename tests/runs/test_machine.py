import ctypes
import subprocess
import sys

import pytest

from giril_rl.runs.machine import keep_freed_memory

CODE = """
import resource, sys
import torch
from giril_rl.runs.machine import keep_freed_memory

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(20):
        torch.ones(2**21)  # 8 MiB, 2,048 pages
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

if sys.argv[1] == "kept":
    assert keep_freed_memory({})
faults()
print(faults())
"""


def page_faults(how):
    done = subprocess.run(
        [sys.executable, "-c", CODE, how],
        capture_output=True,
        text=True,
        check=True,
        env={"OMP_NUM_THREADS": "1", "MALLOC_MMAP_THRESHOLD_": "131072"} if how == "not" else None,
    )
    return int(done.stdout)


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallopt"), reason="not glibc")
def test_memory_is_not_mapped_anew_for_each_tensor():
    assert page_faults("kept") < 2_000 < 20_000 < page_faults("not")


@pytest.mark.parametrize("name", ["MALLOC_MMAP_THRESHOLD_", "GLIBC_TUNABLES"])
def test_the_users_own_setting_stays(name):
    assert not keep_freed_memory({name: "1"})


def test_without_glibc_nothing_is_done(monkeypatch):
    def other(name):
        return object()

    monkeypatch.setattr(ctypes, "CDLL", other)
    assert not keep_freed_memory({})
