"""Keep where a dataset stands, in a table of passes that it shares with its loader workers.

1. A pass (an iteration of the dataset) begins at the *start*, which ``set_epoch`` and ``load_state_dict`` set.
2. A pass that has delivered all its batches moves the start to the next epoch, unless the start was set since the pass
   began. W loader workers share a pass: worker w delivers batches w, w + W, w + 2 W ... of it, and the last one to
   finish ends it. A pass that is left early moves nothing, so the next pass repeats its samples.
3. A process and its loader workers share one table. Each rank, or other process that gets the dataset, has its own.
4. Each batch carries the rank's state after it (``Batch.resume_state``), which is a start for any loader. A loader that
   saves each worker (torchdata's) gets the start of the pass, and the batches that the worker delivered since.

``DataLoader(num_workers=...)`` copies the dataset into other processes by fork or by pickling, and tells the original
nothing. So all copies change the table under a lock. It is in a file without a name: in memory where the system has
``memfd_create``, and never in /dev/shm, which may be missing or tiny in a container. The file is gone with the last
process that has it open, however that process ends. A killed process leaves no lock, and its change is either complete
or not made.

Passes of loader workers have a name that their workers share, because a worker may begin late: after its siblings have
delivered batches, or after the dataset was told to go elsewhere.
"""

from __future__ import annotations

import copy
import dataclasses
import fcntl
import multiprocessing
import os
import pickle
import struct
import tempfile
import threading
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing.context import get_spawning_popen
from multiprocessing.reduction import DupFd
from typing import Any

import psutil
from torch.utils.data import get_worker_info

from v2v_client.position import Consumer, EpochPlan, LoaderShare, ResumeState, Snapshot, StreamIdentity
from v2v_protocol.errors import UsageError

_MOST_PASSES = 8
"""Passes that are remembered. Loader workers may still join and finish them."""
_HEAD = struct.Struct("<QQ")
_HALF_BYTES = 1 << 30
"""Space for each of two versions of the tables; the head names the valid one. Unused space takes no memory."""
_PREFETCHED = 2
"""Batches that each loader worker prefetches by default."""
_LOOKS = 2
"""Passes that may begin at one place without a warning. One that delivers more than a look at the data counts twice."""

_REPEATED = (
    "the last pass was left before the end of epoch {epoch}, and this pass delivers the same samples again. To resume "
    "instead, call dataset.load_state_dict(batch.resume_state), with the last batch trained on, before each pass; for "
    "other samples, call dataset.set_epoch(n) with another n for each pass. To repeat them on purpose, call "
    "dataset.set_epoch({epoch}) before each pass. Loader workers count the batches that they have prefetched: ignore "
    "this if the loop took only one batch to inspect it"
)


@dataclass(slots=True)
class Start:
    """Hold a place where passes begin.

    Attributes:
        state: the place; its ``share`` is None.
        shares: batches that loader worker w of W has delivered from there, as {(w, W): batches}, if a stateful loader
            restored them.
        loaded: whether a saved state put the start there.
        named: whether :meth:`Table.set_epoch` named its epoch.
        looks: number of passes that began there; one that delivered more than a look at the data takes counts twice.
    """

    state: ResumeState
    shares: dict[tuple[int, int], int] = field(default_factory=dict)
    loaded: bool = False
    named: bool = False
    looks: int = 0


@dataclass(slots=True)
class Pass:
    """Hold one iteration of the dataset.

    Attributes:
        name: known to the loader workers of the pass; two passes have the same one if a loader is restored twice with
            the same seeds. None for a pass of one process.
        start: where it began.
        workers: number of processes that share its batches.
        processes: the numbers of those that have begun, and whether each has finished.
    """

    name: str | None
    start: Start
    workers: int
    processes: dict[int, bool] = field(default_factory=dict)


@dataclass(slots=True)
class Table:
    """Hold what all copies of a dataset agree on: where the next pass begins, and which passes have begun. Pure.

    Attributes:
        start: where the next pass begins.
        stream: what the samples are made of, once known.
        stale: whether loader workers have begun a pass since the original dataset last knew where it stood.
        warned: whether a pass has already warned that it repeats samples.
        passes: the newest passes, by number.
    """

    start: Start
    stream: StreamIdentity | None = None
    stale: bool = False
    warned: bool = False
    passes: dict[int, Pass] = field(default_factory=dict)

    def next_start(self, consumer: Consumer) -> ResumeState:
        """Return where the next pass begins, in the consumer's world size."""
        state = consumer.adopt(dataclasses.replace(self.start.state, stream=self.stream))
        # set_epoch may name a loaded epoch of which less than a global batch is left: the next pass has no batches.
        return state if self.start.named else consumer.skip_rest(state)

    def set_epoch(self, epoch: int) -> None:
        """Start the next pass at ``epoch``: at the loaded position, if that is in ``epoch``, else at its beginning.

        Raises:
            UsageError: a state of a later epoch was loaded, and nothing has been delivered from it.
        """
        start = self.start
        if start.loaded and not start.looks and epoch < start.state.epoch:
            raise UsageError(
                f"set_epoch({epoch}): the loaded state is in epoch {start.state.epoch}, and samples of earlier epochs "
                "would be repeated; count epochs from dataset.epoch after a resume. accelerate's prepare() counts from "
                "0: leave the loader out of prepare(), and use batch.to(accelerator.device)"
            )
        is_same = epoch == start.state.epoch
        self.start = Start(start.state, start.shares) if is_same else Start(start.state.at_epoch(epoch))
        self.start.named, self.stale = True, False

    def load(self, state: ResumeState) -> None:
        """Start the next pass where ``state`` was taken."""
        self.start = Start(dataclasses.replace(state, share=None), loaded=True)
        self.stream = state.stream or self.stream

    def begin(self, name: str | None, worker: int, workers: int, loaded: ResumeState | None = None) -> tuple[int, bool]:
        """Begin a pass, or join the one of that name if this worker has not joined it yet.

        Args:
            name: of the pass; None begins a pass of this process alone.
            worker, workers: which process of how many.
            loaded: the state that this loader worker was restored to. That of the first worker decides for all.

        Returns:
            the number of the pass, and whether this worker is to warn that it repeats samples.
        """
        self.stale = name is not None
        number = max((number for number, item in self.passes.items() if name and item.name == name), default=0)
        repeats = False
        if not number or worker in self.passes[number].processes:
            if loaded is not None:
                self.load(loaded)
            repeats = self.start.looks >= _LOOKS and not self.warned
            self.warned = self.warned or repeats
            self.start.looks += 1
            number = max(self.passes, default=0) + 1
            self.passes[number] = Pass(name, self.start, workers)
            self.passes.pop(number - _MOST_PASSES, None)
        item = self.passes[number]
        item.processes.setdefault(worker, False)
        if loaded is not None and loaded.share is not None and loaded.place == item.start.state.place:
            item.start.shares[worker, workers] = loaded.share.batches
        return number, repeats

    def deliver(self, number: int, worker: int, *, used: bool = False, finished: bool = False) -> None:
        """Record what a process has delivered of a pass. The last one to finish makes the start of the next epoch.

        If the start has changed since the pass began, it stays.

        Args:
            used: whether it is now more than a look at the data takes.
            finished: whether it is all of the process's batches.
        """
        item = self.passes.get(number)
        if item is None:
            return
        item.start.looks += used
        item.processes[worker] |= finished
        if sum(item.processes.values()) == item.workers and item.start is self.start:
            self.start = Start(self.start.state.at_epoch(self.start.state.epoch + 1))


class Shared:
    """Hold one process's access to the file of tables, by the process that owns each.

    Pickled while a process is being spawned, it stays the same file. Any other copy is a file of its own.
    """

    def __init__(self, table: Table | None, inherited: Any = None) -> None:
        if inherited is not None:
            self._descriptor = inherited.detach()
        elif hasattr(os, "memfd_create"):
            self._descriptor = os.memfd_create("v2v-passes")
        else:
            self._descriptor, path = tempfile.mkstemp(prefix="v2v-passes-")
            os.unlink(path)
        weakref.finalize(self, os.close, self._descriptor)
        if table is not None:
            self._write({_owner(): table}, at=_HALF_BYTES)

    def __reduce__(self) -> tuple[Any, ...]:
        return Shared, ((self.read(),) if get_spawning_popen() is None else (None, DupFd(self._descriptor)))

    def read(self) -> Table:
        """Return a copy of the table."""
        with self.change() as table:
            return table

    @contextmanager
    def change(self) -> Iterator[Table]:
        """Yield this process's table, locked, and write it back at the end unless an error is raised."""
        with _threads:
            fcntl.lockf(self._descriptor, fcntl.LOCK_EX)  # the system releases it when this process ends
            try:
                at, size = _HEAD.unpack(os.pread(self._descriptor, _HEAD.size, 0))
                tables: dict[int, Table] = pickle.loads(os.pread(self._descriptor, size, at))
                owner = _owner()
                if owner not in tables:
                    tables[owner] = copy.deepcopy(next(iter(tables.values())))
                    for ended in [other for other in list(tables)[1:-1] if not psutil.pid_exists(other)]:
                        del tables[ended]
                yield tables[owner]
                self._write(tables, at=3 * _HALF_BYTES - at)
            finally:
                fcntl.lockf(self._descriptor, fcntl.LOCK_UN)

    def _write(self, tables: dict[int, Table], *, at: int) -> None:
        packed = pickle.dumps(tables)
        os.pwrite(self._descriptor, packed, at)
        os.pwrite(self._descriptor, _HEAD.pack(at, len(packed)), 0)  # so few bytes cannot be half written


def _owner() -> int:
    """Return the id of the process that this one takes batches for: its own, or that of a loader worker's parent."""
    parent = None if get_worker_info() is None else multiprocessing.parent_process()
    return (parent and parent.pid) or os.getpid()


_threads = threading.RLock()
if hasattr(os, "register_at_fork"):  # otherwise a child could start in the middle of another thread's change
    os.register_at_fork(before=_threads.acquire, after_in_parent=_threads.release, after_in_child=_threads.release)


@dataclass(frozen=True, slots=True)
class Iteration:
    """Hold one process's part of a pass, as it began.

    Attributes:
        number: of the pass.
        state: where the pass begins.
        worker, workers: which loader worker of how many; 0 of 1 without loader workers.
        in_loader: whether this process is a loader worker.
        done: batches of this worker's share that were delivered before.
        repeats: whether to warn that this pass repeats samples.
    """

    number: int
    state: ResumeState
    worker: int = 0
    workers: int = 1
    in_loader: bool = False
    done: int = 0
    repeats: bool = False

    @property
    def warning(self) -> str:
        """Return the text of the warning that samples are repeated."""
        return _REPEATED.format(epoch=self.state.epoch)

    @property
    def looked(self) -> int:
        """Return the number of batches that this process makes for a loop that takes one batch."""
        return (_PREFETCHED if self.in_loader else 0) + (self.worker == 0)

    def batches(self, plan: EpochPlan) -> range:
        """Return the numbers of the batches that this process still has to deliver."""
        return range(self.worker, plan.batches, self.workers)[self.done :]

    def after(self, consumer: Consumer, delivered: int, quarantine: Snapshot) -> ResumeState:
        """Return the state of this loader worker after ``delivered`` batches of this iteration."""
        share = LoaderShare(self.worker, self.workers, consumer.batch_size, self.done + delivered)
        return dataclasses.replace(self.state, share=share, quarantine=quarantine)


class Position:
    """Hold where this copy of a dataset stands. A shallow copy shares the table, and iterates on its own.

    Args:
        seed: of the stream.
        epoch: the first epoch.
    """

    def __init__(self, seed: int, epoch: int) -> None:
        self._shared = Shared(Table(Start(ResumeState(None, seed, epoch, 0, 0, 1))))
        self._iterations = 0
        self._newest = 0  # number of the newest pass that this copy began
        self._delivered = 0  # batches of that pass that left this process
        self._here: ResumeState | None = None  # after the last batch of this process; None: the start
        self._loaded: ResumeState | None = None  # what a stateful loader gave this loader worker for its next pass

    @property
    def stream(self) -> StreamIdentity | None:
        """Return what the samples are made of; None before the first connection or loaded state."""
        return self._shared.read().stream

    def start(self, consumer: Consumer) -> ResumeState:
        """Return where the next pass begins."""
        return self._shared.read().next_start(consumer)

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch of the next pass; see :meth:`Table.set_epoch`.

        Raises:
            UsageError: a state of a later epoch was loaded, and nothing has been delivered from it.
        """
        with self._shared.change() as table:
            table.set_epoch(epoch)
        self._here = None

    def state(self, consumer: Consumer) -> ResumeState:
        """Return the state after the last batch that this process took.

        Raises:
            UsageError: loader workers took the batches; only they know the position.
        """
        if self._here is not None and get_worker_info() is not None:
            return self._here
        table = self._shared.read()
        if table.stale:
            raise UsageError(
                "state_dict: the batches went through DataLoader workers, and this process does not know which of them "
                "were used; save Batch.resume_state of the last batch you trained on instead"
            )
        return self._here or table.next_start(consumer)

    def load(self, saved: ResumeState, consumer: Consumer) -> None:
        """Start the next pass where ``saved`` was taken.

        Raises:
            UsageError: it is the state of another loader worker.
        """
        worker = get_worker_info()
        _require_share(saved, worker, consumer)
        state = consumer.adopt(saved)
        if worker is not None:
            self._here = self._loaded = state if state.share else consumer.skip_rest(state)
            return
        with self._shared.change() as table:
            table.load(state)
            table.stale = False
        self._here = None

    def begin(self, consumer: Consumer) -> Iteration:
        """Begin a pass, or this loader worker's part of one. Older iterations no longer affect the position."""
        self._iterations += 1
        loader = get_worker_info()
        name, worker, workers = None, 0, 1
        if loader is not None:
            # PyTorch seeds the workers of a loader alike, and they iterate equally often.
            name, worker, workers = f"{loader.seed - loader.id}:{self._iterations}", loader.id, loader.num_workers
        with self._shared.change() as table:
            start = table.next_start(consumer)
            if start.place != table.start.state.place:
                table.start = Start(start, loaded=table.start.loaded)
            number, repeats = table.begin(name, worker, workers, self._loaded)
            begun = table.passes[number].start
            state = consumer.adopt(dataclasses.replace(begun.state, stream=table.stream))
        self._loaded, self._newest, self._delivered = None, number, 0
        done = begun.shares.get((worker, workers), 0)
        iteration = Iteration(number, state, worker, workers, loader is not None, done, repeats)
        self._here = state if loader is None else iteration.after(consumer, 0, state.quarantine)
        return iteration

    def pin(self, begun: Iteration, stream: StreamIdentity, address: str) -> Iteration:
        """Record the stream that a server offered to an iteration, and return the iteration with it.

        Raises:
            StateMismatch: a loader worker was offered another one before.
        """
        with self._shared.change() as table:
            first = table.stream = table.stream or stream
        first.require_same(stream, ours="another loader worker", theirs=address)
        return dataclasses.replace(begun, state=dataclasses.replace(begun.state, stream=stream))

    def reached(self, begun: Iteration, consumer: Consumer, state: ResumeState, *, last: bool) -> None:
        """Record that a batch leaves an iteration now.

        Args:
            state: the rank's state after it.
            last: whether it is the last one. A loop that counts batches may never ask for another.
        """
        if begun.number != self._newest:  # an older iterator that is still read
            return
        self._delivered += 1
        self._here = begun.after(consumer, self._delivered, state.quarantine) if begun.in_loader else state
        is_used = self._delivered == begun.looked + 1
        if is_used or last:
            with self._shared.change() as table:
                table.deliver(begun.number, begun.worker, used=is_used, finished=last)

    def finish(self, begun: Iteration) -> None:
        """Record that an iteration has delivered all its batches, and was asked for one more."""
        if begun.number != self._newest:
            return
        with self._shared.change() as table:
            table.deliver(begun.number, begun.worker, finished=True)
        self._here = begun.state.at_epoch(begun.state.epoch + 1) if begun.in_loader else None


def _require_share(state: ResumeState, loader: Any, consumer: Consumer) -> None:
    """Check that a loader worker's state is loaded by the same worker of an equal loader.

    Args:
        loader: PyTorch's description of the loader worker that this process is; None if it is none.

    Raises:
        UsageError: another process loads it.
    """
    share = state.share
    here = None if loader is None else (loader.id, loader.num_workers, consumer.batch_size, consumer.world_size)
    if share is None or here == (share.worker, share.workers, share.batch_size, state.world_size):
        return
    raise UsageError(
        f"this is the state of loader worker {share.worker} of {share.workers} (batch_size {share.batch_size}, world "
        f"size {state.world_size}); only the same worker of an equal loader can continue from it. Batch.resume_state "
        "is valid for any number of loader workers"
    )
