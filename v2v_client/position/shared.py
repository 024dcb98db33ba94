"""What all copies of a dataset agree on: the original, and one in each loader worker.

``DataLoader(num_workers=...)`` copies the dataset into processes of its own, by fork or by pickling, and tells the
original nothing. What is kept all the same:

    all loader workers of an iteration deliver the same epoch, from the same state, however late one of them starts;
    an epoch ends when the last of them has delivered its share, and the next iteration, of whatever workers, delivers
    the one after it;
    unless an epoch was set, or a state loaded, since their iteration began: then theirs was left early, and what they
    prefetched of it says nothing;
    the original knows that loader workers went on without it, so that its own state is stale;
    all of them are offered the same stream.

So they share a small record, :class:`Agreed`, and change it under a lock: in a file without a name (in memory where the
system has such; never in /dev/shm, which may be missing or tiny in a container), which is gone with the last process
that has it open, however that one ends. A process that is killed leaves no lock, and the record as it was before or
after its change.

A rank, or any other process that is no loader worker, may be forked or spawned with the dataset too. Its epochs are its
own, so it goes on with a copy of the record, made before it or a loader worker of its own changes it.
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
from dataclasses import dataclass, field, replace
from multiprocessing.context import get_spawning_popen
from multiprocessing.reduction import DupFd
from typing import Any

from torch.utils.data import get_worker_info

from v2v_client.position.state import ResumeState, StreamIdentity

_MOST_ITERATIONS = 8
"""That loader workers may still join, or finish."""
_HALF_BYTES = 1 << 30
"""The file has room for two records, of which its first byte names the valid one; what is not used takes no memory."""


@dataclass(slots=True)
class LoaderIteration:
    """One iteration that loader workers share.

    Attributes:
        number: that no other one of this record has.
        name: by which they know it; another one may have it, where a loader is restored again with the same seeds.
        epoch, state: what it delivers, and from where; None: from the beginning.
        beginnings: see :class:`Agreed`, when it began.
        started, finished: loader workers.
        repeats: see :meth:`Agreed.repeats`, for the loader worker that began it.
    """

    number: int
    name: str
    epoch: int
    state: ResumeState | None
    beginnings: int
    started: set[int] = field(default_factory=set)
    repeats: bool = False
    finished: set[int] = field(default_factory=set)


@dataclass(slots=True)
class Agreed:
    """The record.

    Attributes:
        epoch: the epoch that the next iteration delivers.
        state: where it begins; None at its beginning.
        stream: what the samples are made of, once known.
        stale: loader workers have begun to iterate since the original last knew where it stood.
        beginnings: how often an epoch was set or begun.
        used: the value of ``beginnings`` at which an iteration last delivered more than a first look takes.
        warned: an iteration has repeated one that was left early, and the user was told.
        numbers: iterations of loader workers so far.
        iterations: the last of them, the newest last.
    """

    epoch: int
    state: ResumeState | None = None
    stream: StreamIdentity | None = None
    stale: bool = False
    beginnings: int = 0
    used: int = -1
    warned: bool = False
    numbers: int = 0
    iterations: list[LoaderIteration] = field(default_factory=list)

    def begin(self, epoch: int, state: ResumeState | None) -> None:
        """The next iteration delivers ``epoch``, from ``state`` on."""
        self.epoch, self.state = epoch, state
        self.beginnings += 1
        if state is not None and state.stream is not None:
            self.stream = state.stream

    def repeats(self) -> bool:
        """Return whether the next iteration is the first to repeat one that was left early; True at most once."""
        first = self.used == self.beginnings and not self.warned
        self.warned = self.warned or first
        return first

    def start(self, name: str, worker: int, loaded: ResumeState | None) -> LoaderIteration:
        """A loader worker begins to iterate: with those of that name, if it has not begun with them already.

        Args:
            name: of the iteration.
            worker: which one.
            loaded: the state that it was restored to. The first of an iteration decides for all.
        """
        self.stale = True
        for iteration in reversed(self.iterations):
            if iteration.name == name:
                if worker not in iteration.started:
                    iteration.started.add(worker)
                    iteration.repeats = False
                    return iteration
                break
        if loaded is not None:
            self.begin(loaded.epoch, replace(loaded, share=None))
        self.numbers += 1
        iteration = LoaderIteration(self.numbers, name, self.epoch, self.state, self.beginnings, {worker})
        iteration.repeats = self.repeats()
        self.iterations = [*self.iterations, iteration][-_MOST_ITERATIONS:]
        return iteration

    def finish(self, number: int, worker: int, workers: int) -> None:
        """A loader worker has delivered its share; when all have, the next epoch begins."""
        for iteration in self.iterations:
            if iteration.number == number and iteration.beginnings == self.beginnings:
                iteration.finished.add(worker)
                if len(iteration.finished) == workers:
                    self.begin(self.epoch + 1, None)
                return


class Shared:
    """The record, as one process has it. Pickled while a loader worker is being spawned it stays the same; copied in
    any other way it becomes one of its own."""

    def __init__(self, epoch: int) -> None:
        self._create(Agreed(epoch))

    def _create(self, agreed: Agreed) -> None:
        if hasattr(os, "memfd_create"):
            descriptor = os.memfd_create("v2v-position")
        else:
            descriptor, path = tempfile.mkstemp(prefix="v2v-position-")
            os.unlink(path)
        self._adopt(descriptor, os.getpid())
        self._write(agreed, half=0)

    def _adopt(self, descriptor: int, process: int) -> None:
        self._descriptor = descriptor
        self._process = process  # whose record it is: its own and that of its loader workers
        self._close = weakref.finalize(self, os.close, descriptor)
        _all.add(self)

    def part(self) -> None:
        """Goes on with a record of its own, if this is that of another process, whose loader worker this one is not."""
        if self._process == os.getpid() or get_worker_info() is not None:
            return
        with self._locked():
            agreed, _ = self._read()
        close = self._close
        self._create(agreed)
        close()

    def __getstate__(self) -> dict[str, Any]:
        agreed = self.agreed()
        if get_spawning_popen() is not None:
            return {"descriptor": DupFd(self._descriptor), "process": self._process}
        return {"agreed": agreed}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        if "descriptor" in state:
            self._adopt(state["descriptor"].detach(), state["process"])
        else:
            self._create(state["agreed"])

    def agreed(self) -> Agreed:
        """The record now; a copy."""
        self.part()
        with self._locked():
            return self._read()[0]

    @contextmanager
    def change(self) -> Iterator[Agreed]:
        """The record, to be changed; nobody else reads or changes it meanwhile."""
        self.part()
        with self._locked():
            agreed, half = self._read()
            yield agreed
            self._write(agreed, half=1 - half)

    @contextmanager
    def _locked(self) -> Iterator[None]:
        with _threads:
            fcntl.lockf(self._descriptor, fcntl.LOCK_EX)  # of this process, and gone with it
            try:
                yield
            finally:
                fcntl.lockf(self._descriptor, fcntl.LOCK_UN)

    def _read(self) -> tuple[Agreed, int]:
        half = os.pread(self._descriptor, 1, 0)[0]
        at = 1 + half * _HALF_BYTES
        size = int.from_bytes(os.pread(self._descriptor, 8, at), "little")
        agreed: Agreed = pickle.loads(os.pread(self._descriptor, size, at + 8))
        return agreed, half

    def _write(self, agreed: Agreed, *, half: int) -> None:
        packed = pickle.dumps(agreed)
        os.pwrite(self._descriptor, len(packed).to_bytes(8, "little") + packed, 1 + half * _HALF_BYTES)
        os.pwrite(self._descriptor, bytes([half]), 0)  # a byte is written or not


_all: weakref.WeakSet[Shared] = weakref.WeakSet()
_threads = threading.RLock()


def _before_fork() -> None:
    _threads.acquire()  # or another thread's change would be half done in the child
    for shared in list(_all):
        # What is forked may be a loader worker, and must find the record of the process that it works for.
        shared.part()


def _after_fork_in_child() -> None:
    global _threads
    _threads = threading.RLock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(
        before=_before_fork, after_in_parent=lambda: _threads.release(), after_in_child=_after_fork_in_child
    )
