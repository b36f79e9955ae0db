"""Every moment at which a process touches a file below a folder, and what may go wrong there."""

import builtins
import errno
import io
import os
import signal
import sys
from pathlib import Path

CHANGES = {"os.rename", "os.remove", "os.mkdir", "os.rmdir"}
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT


class Points:
    """Counts them, and lets one of them fail.

    A point is the moment before a file is opened for writing, renamed, removed, made or synced, and
    the moment in the middle of a write. Installed for good: only for a process that ends soon.

    Args:
        root: the folder; what happens elsewhere is not counted.
        kill_at: the process kills itself with SIGKILL at the point of this number, counted from 1,
            with half of the data written if it is a write.
        error: the name of an error, such as ENOSPC, that every write from ``error_at`` on meets.
        error_at: number of the first write, or opening for a write, that meets it.
    """

    def __init__(self, root, *, kill_at=None, error=None, error_at=1):
        self.root = os.path.join(os.path.abspath(root), "")
        self.kill_at, self.error, self.error_at = kill_at, error, error_at
        self.count = self.writes = 0

    def install(self):
        sys.addaudithook(self._audit)
        real_open, real_sync = builtins.open, os.fsync

        def opened(file, mode="r", *args, **kwargs):
            made = real_open(file, mode, *args, **kwargs)
            return Written(made, self) if set(mode) & set("wax+") and self._below(file) else made

        def synced(handle):
            self.reach()
            real_sync(handle)

        builtins.open = io.open = opened
        os.fsync = synced

    def reach(self, half=lambda: None):
        """A point is reached; ``half`` does a part of what is about to be done."""
        self.count += 1
        if self.count == self.kill_at:
            half()
            os.kill(os.getpid(), signal.SIGKILL)

    def fail(self, path=None):
        """Raises the error if it is time for it; ``path`` where the system would say it."""
        if self.error is not None:
            self.writes += 1
            if self.writes >= self.error_at:
                code = getattr(errno, self.error)
                raise OSError(code, os.strerror(code), path)

    def _below(self, path):
        if isinstance(path, int) or path is None:
            return False
        return os.path.abspath(os.fsdecode(path)).startswith(self.root)

    def _audit(self, event, args):
        if event == "open" and args[2] & WRITING and self._below(args[0]):
            if Path(os.fsdecode(args[0])).suffix != ".lock":
                self.fail(os.fsdecode(args[0]))
            self.reach()
        elif event in CHANGES and self._below(args[0]):
            self.reach()


class Written:
    """A file that is open for writing; each write is a point."""

    def __init__(self, file, points):
        self._file, self._points = file, points

    def write(self, data):
        def half():
            self._file.write(data[: len(data) // 2])
            self._file.flush()

        self._points.fail()
        self._points.reach(half)
        return self._file.write(data)

    def __getattr__(self, name):
        return getattr(self._file, name)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self._file.close()

    def __iter__(self):
        return iter(self._file)
