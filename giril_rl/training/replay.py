"""The replay buffer of a run: on disk, never copied, and restored to any checkpoint's moment."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import MemoryMappedTensor, TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer, TensorStorage
from torchrl.data.replay_buffers import RoundRobinWriter, Sampler

from giril_rl.errors import UserError

_DTYPES = {
    str(kind): kind
    for kind in (torch.bool, torch.uint8, torch.int32, torch.int64, torch.float32, torch.float64)
}


class Replay:
    """TorchRL's replay buffer over memory-mapped files; minibatches are drawn uniformly.

    It holds the latest ``size`` transitions. A checkpoint says how many were written, and the files
    stay as they are: behind the latest ``size`` rows lie ``slack`` older ones, so that a run that
    was killed finds the rows of its last checkpoint as they were then.

    Demonstrated transitions may stand beside the agent's. They are never overwritten.

    Args:
        keys: the entries that are kept of a batch.
        size: most transitions of the agent.
        slack: most transitions that are written between two checkpoints.
        folder: where the files are; None keeps the transitions in memory.
        demonstration: a flat batch with ``keys``, or None.
        share: part of each minibatch that is demonstrated; None draws from all transitions alike.

    Examples:
        >>> replay = Replay(["observation"], size=100)
        >>> replay.extend(TensorDict({"observation": torch.zeros(8, 2)}, [8]))
        >>> replay.sample(3)["observation"].shape, len(replay)
        (torch.Size([3, 2]), 8)
    """

    def __init__(
        self,
        keys: Sequence[NestedKey],
        *,
        size: int,
        slack: int = 0,
        folder: Path | None = None,
        demonstration: TensorDictBase | None = None,
        share: float | None = None,
    ) -> None:
        self.keys, self.size, self.capacity = list(keys), size, size + slack
        self.folder, self.share = folder, share
        self._demonstration = (
            None if demonstration is None else demonstration.select(*keys).contiguous()
        )
        self.written = 0
        self._sums: list[list[int]] = []  # First row, the row after the last, checksum.
        self._kinds: list[tuple[torch.dtype, list[int]]] = []
        self._columns: list[Tensor] = []
        self._buffer: TensorDictReplayBuffer | None = None

    def __len__(self) -> int:
        """Transitions of the agent that may be drawn."""
        return min(self.written, self.size)

    def extend(self, batch: TensorDictBase) -> None:
        """Adds a flat batch, of which later changes are not seen."""
        rows = batch.select(*self.keys)
        if self._buffer is None:
            entries = [rows.get(key) for key in self.keys]
            self._open([(entry.dtype, entry.shape[1:]) for entry in entries])
        assert self._buffer is not None
        self._buffer.extend(rows)
        self.written += len(rows)

    def own(self, count: int) -> TensorDictBase:
        """Draws ``count`` of the agent's own transitions alone, see :meth:`sample`."""
        if self._buffer is None or not self.written:
            raise ValueError("nothing was stored yet")
        return self._buffer.sample(count).select(*self.keys)

    def sample(self, count: int, *, minibatch: int | None = None) -> TensorDictBase:
        """Draws ``count`` transitions with torch's global generator, a new flat batch.

        Args:
            count: how many.
            minibatch: size of the minibatches that they will be split into, each of which gets its
                ``share`` of the demonstration.
        """
        demonstrated = self._where_demonstrated(count, minibatch or count)
        drawn = self.own(count)
        if demonstrated is not None and len(demonstrated):
            assert self._demonstration is not None
            rows = torch.randint(len(self._demonstration), demonstrated.shape)
            for key in self.keys:
                drawn.get(key)[demonstrated] = self._demonstration.get(key)[rows]
        return drawn

    def _where_demonstrated(self, count: int, minibatch: int) -> Tensor | None:
        if self._demonstration is None:
            return None
        if self.share is None:
            known = len(self._demonstration)
            chosen = torch.rand(count) < known / (known + len(self))
        else:
            chosen = torch.arange(count) % minibatch < round(minibatch * self.share)
        return chosen.nonzero().squeeze(-1)

    def _open(self, kinds: Sequence[tuple[torch.dtype, Sequence[int]]]) -> None:
        """Makes the columns, or finds those of a checkpoint; ``kinds`` has one row's entries."""
        self._kinds = [(kind, list(shape)) for kind, shape in kinds]
        storage = TensorDict(batch_size=[self.capacity])
        for key, (kind, shape) in zip(self.keys, self._kinds, strict=True):
            storage.set(key, self._column(key, (self.capacity, *shape), kind))
        self._columns = [storage.get(key) for key in self.keys]
        writer = RoundRobinWriter()
        self._buffer = TensorDictReplayBuffer(
            storage=TensorStorage(storage), sampler=_Latest(self), writer=writer
        )
        writer.load_state_dict({**writer.state_dict(), "_cursor": self.written % self.capacity})

    def _column(self, key: NestedKey, shape: tuple[int, ...], kind: torch.dtype) -> Tensor:
        if self.folder is None:
            return torch.zeros(shape, dtype=kind)
        path = self.folder / f"{_name(key)}.memmap"
        if not self.written:
            self.folder.mkdir(parents=True, exist_ok=True)
            path.unlink(missing_ok=True)
            return MemoryMappedTensor.empty(shape, dtype=kind, filename=str(path))
        needed = torch.Size(shape).numel() * kind.itemsize
        if not path.is_file() or path.is_symlink() or path.stat().st_size != needed:
            raise self._damaged(f"{path.name} is missing or has another size")
        return MemoryMappedTensor.from_filename(str(path), kind, torch.Size(shape))

    def state_dict(self) -> dict[str, Any]:
        """How many transitions were written and of what kind, with checksums of those on disk.

        The transitions themselves are not in it.
        """
        begin = self._sums[-1][1] if self._sums else 0
        if begin < self.written:
            self._sums.append([begin, self.written, self._checksum(begin, self.written)])
        self._sums = [part for part in self._sums if part[1] > self.written - self.size]
        return {
            "written": self.written,
            "sums": [list(part) for part in self._sums],
            "keys": [_name(key) for key in self.keys],
            "kinds": [[str(kind), list(shape)] for kind, shape in self._kinds],
        }

    @staticmethod
    def keys_of(state: dict[str, Any]) -> list[NestedKey]:
        """The keys that a buffer with this state has."""
        keys = (tuple(name.split(".")) for name in state["keys"])
        return [key if len(key) > 1 else key[0] for key in keys]

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Goes back to the moment of a checkpoint.

        Raises:
            UserError: if the files are not those of that moment.
            ValueError: if the transitions were in memory alone.
        """
        if state["written"] and self.folder is None:
            raise ValueError("the replay buffer was in memory, and is gone")
        self.written = state["written"]
        self._sums = [[int(number) for number in part] for part in state["sums"]]
        if self.written:
            self._open([(_DTYPES[kind], shape) for kind, shape in state["kinds"]])
        self._check_sums()

    def _check_sums(self) -> None:
        for begin, end, checksum in self._sums:
            whole = begin >= self.written - self.capacity
            if whole and checksum != self._checksum(begin, end):
                raise self._damaged(f"the transitions {begin:,} to {end:,} have changed")

    def _damaged(self, what: str) -> UserError:
        return UserError(
            f"the replay buffer in {self.folder} is not that of the checkpoint ({what}): restore a "
            "copy of the run's folder, or delete it to start anew."
        )

    def _checksum(self, begin: int, end: int) -> int:
        rows, total = torch.arange(begin, end) % self.capacity, 0
        for column in self._columns:
            values = column[rows].contiguous().view(torch.uint8)
            total = zlib.crc32(values.numpy().data, total)
        return total


def _name(key: NestedKey) -> str:
    return ".".join(key) if isinstance(key, tuple) else key


class _Latest(Sampler):
    """Uniform over the latest rows, older ones being kept for resuming alone."""

    def __init__(self, replay: Replay) -> None:
        super().__init__()
        self.replay = replay

    def sample(self, storage: Any, batch_size: int) -> tuple[Tensor, dict[str, Any]]:
        age = torch.randint(len(self.replay), (batch_size,))
        return (self.replay.written - 1 - age) % self.replay.capacity, {}

    def _empty(self) -> None:
        pass

    def dumps(self, path: Any) -> None:
        pass

    def loads(self, path: Any) -> None:
        pass

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        pass
