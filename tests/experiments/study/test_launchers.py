"""What runs with ``device=cuda`` ask for, on Ray and on this machine; no GPU is needed."""

import runpy
import signal
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from giril_rl.errors import UserError
from giril_rl.experiments.study.launchers import LocalLauncher, RayLauncher


def a_run(name, device="cuda"):
    config = SimpleNamespace(device=device, threads=2)
    return SimpleNamespace(name=name, config=config, command=["run", "x"])


@pytest.fixture
def ray(monkeypatch):
    """A cluster that notes what it is asked for."""
    fake = ModuleType("ray")
    fake.__spec__ = ModuleSpec("ray", None)
    fake.asked, fake.resources = [], {"CPU": 16.0, "GPU": 2.0}
    fake.init = lambda **kwargs: None
    fake.shutdown = lambda: None
    fake.cluster_resources = lambda: fake.resources

    def options(**kwargs):
        fake.asked.append(kwargs)
        return SimpleNamespace(remote=lambda *args: object())

    fake.remote = lambda **kwargs: lambda function: SimpleNamespace(options=options)
    monkeypatch.setitem(sys.modules, "ray", fake)
    return fake


def test_ray_is_asked_for_a_part_of_a_gpu(ray):
    launcher = RayLauncher(len, "auto", per_gpu=4)
    assert launcher.slots == 8
    launcher.start(a_run("a"), Path("a.log"))
    launcher.start(a_run("b", device="cpu"), Path("b.log"))
    assert [asked["num_gpus"] for asked in ray.asked] == [0.25, 0]
    assert [asked["num_cpus"] for asked in ray.asked] == [2, 2]
    assert RayLauncher(len, "auto").slots == 16


def test_a_cluster_without_a_gpu_is_refused(ray):
    ray.resources = {"CPU": 16.0}
    with pytest.raises(UserError, match="has no GPU"):
        RayLauncher(len, "auto", per_gpu=1)
    assert RayLauncher(len, "auto").slots == 16


def test_local_runs_share_the_gpus_evenly(monkeypatch, tmp_path):
    seen = []

    class Process:
        stdin = None

        def __init__(self, words, *, env, **kwargs):
            seen.append(env.get("CUDA_VISIBLE_DEVICES"))
            self.code = None

        def poll(self):
            return self.code

    monkeypatch.setattr("subprocess.Popen", Process)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,5")
    monkeypatch.setattr("os.sched_getaffinity", lambda _: range(32), raising=False)
    launcher = LocalLauncher(["giril"], ["3", "5"], per_gpu=3)
    assert launcher.slots == 6
    for name in "abc":
        launcher.start(a_run(name), tmp_path / "log")
    launcher.start(a_run("d", device="cpu"), tmp_path / "log")
    assert seen == ["3", "5", "3", "3,5"]
    launcher._running["b"][1].code = 0
    launcher.poll()
    launcher.start(a_run("e"), tmp_path / "log")  # In the place of the one that has ended.
    assert seen[-1] == "5"
    assert LocalLauncher([]).slots == 32


def test_runs_are_killed_without_the_signals_name(monkeypatch):
    """Windows does not name SIGKILL; no test runs there."""
    code, said = -int(signal.SIGKILL), []
    monkeypatch.delattr(signal, "SIGKILL")
    launcher = LocalLauncher([])
    process = SimpleNamespace(
        kill=lambda: said.append("kill"), wait=lambda: said.append("wait"), stdin=None
    )
    launcher._running["run"] = None, process
    launcher.close()
    assert said == ["kill", "wait"]
    assert runpy.run_module("giril_rl.experiments.study.launchers")["KILLED"] == code
