"""What Windows lacks of the signals is not needed: a stand-in, for no test runs there."""

import signal

from giril_rl.graphs.compiling import _compiling


def test_compiling_blocks_no_signals(monkeypatch):
    monkeypatch.delattr(signal, "pthread_sigmask")
    with _compiling():
        pass
