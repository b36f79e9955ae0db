"""What Windows lacks of the signals is not needed: a stand-in, for no test runs there."""

import runpy
import signal
from types import SimpleNamespace

from giril_rl.experiments.study.local import LocalLauncher
from giril_rl.graphs.compiling import _compiling


def test_runs_are_killed_without_the_signals_name(monkeypatch):
    code, said = -int(signal.SIGKILL), []
    monkeypatch.delattr(signal, "SIGKILL")
    launcher = LocalLauncher([])
    process = SimpleNamespace(
        kill=lambda: said.append("kill"), wait=lambda: said.append("wait"), stdin=None
    )
    launcher._running["run"] = None, process
    launcher.close()
    assert said == ["kill", "wait"]
    assert runpy.run_module("giril_rl.experiments.study.on_ray")["KILLED"] == code


def test_compiling_blocks_no_signals(monkeypatch):
    monkeypatch.delattr(signal, "pthread_sigmask")
    with _compiling():
        pass
