"""Share the record of a dataset's position between its copies: the original, and one in each loader worker.

``DataLoader(num_workers=...)`` copies the dataset into other processes by fork or by pickling, and tells the original
nothing. So the copies change one :class:`Record` under a lock. It is in a file without a name: in memory where the
system has ``memfd_create``, and never in /dev/shm, which may be missing or tiny in a container. The file is gone with
the last process that has it open, however that process ends. A killed process leaves no lock, and its change is either
complete or not made.

A rank, or any other process that is not a loader worker, may be forked or spawned with the dataset too. It has its own
epochs, so it continues with a copy of the record. The copy is made before it or one of its loader workers changes the
record.
"""

from __future__ import annotations

import fcntl
import os
import pickle
import tempfile
import threading
import weakref
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from multiprocessing.context import get_spawning_popen
from multiprocessing.reduction import DupFd
from typing import Any

from torch.utils.data import get_worker_info

from v2v_client.position.record import Record

_HALF_BYTES = 1 << 30
"""Space for each of two records, of which the file's first byte names the valid one. Unused space takes no memory."""


class Shared:
    """Hold one process's access to a record.

    Pickled while a loader worker is being spawned, it stays the same record. Any other copy is a new record.
    """

    def __init__(self, record: Record) -> None:
        self._create(record)

    def _create(self, record: Record) -> None:
        if hasattr(os, "memfd_create"):
            descriptor = os.memfd_create("v2v-position")
        else:
            descriptor, path = tempfile.mkstemp(prefix="v2v-position-")
            os.unlink(path)
        self._adopt(descriptor, os.getpid())
        self._write(record, half=0)

    def _adopt(self, descriptor: int, process: int) -> None:
        self._descriptor = descriptor
        self._process = process  # the record belongs to this process and its loader workers
        self._close = weakref.finalize(self, os.close, descriptor)
        _all.add(self)

    def part(self) -> None:
        """Continue with a copy of the record, if it belongs to a process that this one is not a loader worker of."""
        if self._process == os.getpid() or get_worker_info() is not None:
            return
        with self._locked():
            record, _ = self._read()
        close = self._close
        self._create(record)
        close()

    def __getstate__(self) -> dict[str, Any]:
        record = self.read()
        if get_spawning_popen() is not None:
            return {"descriptor": DupFd(self._descriptor), "process": self._process}
        return {"record": record}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        if "descriptor" in state:
            self._adopt(state["descriptor"].detach(), state["process"])
        else:
            self._create(state["record"])

    def read(self) -> Record:
        """Return a copy of the record."""
        self.part()
        with self._locked():
            return self._read()[0]

    @contextmanager
    def change(self) -> Iterator[Record]:
        """Yield the record, locked, and write it back at the end unless an error is raised."""
        self.part()
        with self._locked():
            record, half = self._read()
            yield record
            self._write(record, half=1 - half)

    @contextmanager
    def _locked(self) -> Iterator[None]:
        with _threads:
            fcntl.lockf(self._descriptor, fcntl.LOCK_EX)  # the system releases it when this process ends
            try:
                yield
            finally:
                fcntl.lockf(self._descriptor, fcntl.LOCK_UN)

    def _read(self) -> tuple[Record, int]:
        half = os.pread(self._descriptor, 1, 0)[0]
        at = 1 + half * _HALF_BYTES
        size = int.from_bytes(os.pread(self._descriptor, 8, at), "little")
        record: Record = pickle.loads(os.pread(self._descriptor, size, at + 8))
        return record, half

    def _write(self, record: Record, *, half: int) -> None:
        packed = pickle.dumps(record)
        os.pwrite(self._descriptor, len(packed).to_bytes(8, "little") + packed, 1 + half * _HALF_BYTES)
        os.pwrite(self._descriptor, bytes([half]), 0)  # one byte cannot be half written


_all: weakref.WeakSet[Shared] = weakref.WeakSet()
_threads = threading.RLock()


def _before_fork() -> None:
    _threads.acquire()  # otherwise the child could start in the middle of another thread's change
    for shared in list(_all):
        # The child may be a loader worker, which must find the record of the process that it works for.
        shared.part()


def _after_fork_in_child() -> None:
    global _threads
    _threads = threading.RLock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(
        before=_before_fork, after_in_parent=lambda: _threads.release(), after_in_child=_after_fork_in_child
    )
