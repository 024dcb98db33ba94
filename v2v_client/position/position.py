"""Keep where a dataset stands. One mechanism serves every loader and training loop:

1. The next pass (an iteration of the dataset) begins at the *start*: an epoch, and a position in it.
2. ``set_epoch`` and ``load_state_dict`` set the start.
3. A pass that has delivered all its batches sets it to the next epoch, unless it was set since the pass began.
4. A pass that is left early does not set it, so the next pass repeats the same samples.
5. W loader workers share a pass: worker w delivers batches w, w + W, w + 2 W ... of it. The last one finishes it.
6. All copies of a dataset (one in each loader worker) share one record of the start; each rank has its own.
7. Each batch carries the rank's state after it (``Batch.resume_state``), which is a start for any loader.
8. A loader that saves each worker (torchdata's) gets the start of the pass and the batches that the worker delivered.

The record is :mod:`v2v_client.position.record`, and :mod:`v2v_client.position.shared` shares it between processes.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from torch.utils.data import get_worker_info

from v2v_client.position.plan import Consumer, EpochPlan
from v2v_client.position.record import Record, Start
from v2v_client.position.shared import Shared
from v2v_client.position.state import LoaderShare, ResumeState, StreamIdentity
from v2v_protocol.errors import UsageError

_REPEATED = (
    "the last pass was left before the end of epoch {epoch}, and this pass delivers the same samples again. To resume "
    "instead, call dataset.load_state_dict(batch.resume_state), with the last batch trained on, before each pass; for "
    "other samples, call dataset.set_epoch(n) with another n for each pass. To repeat them on purpose, call "
    "dataset.set_epoch({epoch}) before each pass"
)
_OF_A_LOADER_WORKER = (
    ". Loader workers count the batches that they have prefetched: ignore this if the loop took only one batch to "
    "inspect it"
)


@dataclass(frozen=True, slots=True)
class Iteration:
    """Hold one process's part of a pass, as it began.

    Attributes:
        number: of the pass.
        state: where the pass begins.
        worker, workers: which loader worker of how many; 0 of 1 without loader workers.
        in_loader: whether this process is a loader worker.
        done: batches of this worker's share that were delivered before.
        counts: batches of this process to count; more cannot change whether the pass is more than a look.
        repeats: whether to warn that this pass repeats samples.
    """

    number: int
    state: ResumeState
    worker: int = 0
    workers: int = 1
    in_loader: bool = False
    done: int = 0
    counts: int = 2
    repeats: bool = False

    @property
    def warning(self) -> str:
        """Return the text of the warning that samples are repeated."""
        return _REPEATED.format(epoch=self.state.epoch) + (_OF_A_LOADER_WORKER if self.in_loader else "")

    def batches(self, plan: EpochPlan) -> range:
        """Return the numbers of the batches that this process still has to deliver."""
        return plan.batches_of_worker(self.worker, self.workers)[self.done :]

    def after(self, consumer: Consumer, delivered: int, quarantine: int | None) -> ResumeState:
        """Return the state of this loader worker after ``delivered`` batches of this iteration."""
        share = LoaderShare(self.worker, self.workers, consumer.batch_size, self.done + delivered)
        return dataclasses.replace(self.state, share=share, quarantine=quarantine)


class Position:
    """Hold where this copy of a dataset stands. A shallow copy shares the record, and iterates on its own.

    Args:
        seed: of the stream.
        epoch: the first epoch.
    """

    def __init__(self, seed: int, epoch: int) -> None:
        self._shared = Shared(Record(Start(ResumeState(None, seed, epoch, 0, 0, 1))))
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
        return _next_start(self._shared.read(), consumer)

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch of the next pass; see :meth:`v2v_client.position.record.Record.set_epoch`.

        Raises:
            UsageError: a state of a later epoch was loaded, and nothing has been delivered from it.
        """
        with self._shared.change() as record:
            record.set_epoch(epoch)
        self._here = None

    def state(self, consumer: Consumer) -> ResumeState:
        """Return the state after the last batch that this process took.

        Raises:
            UsageError: loader workers took the batches; only they know the position.
        """
        if self._here is not None and get_worker_info() is not None:
            return self._here
        record = self._shared.read()
        if record.stale:
            raise UsageError(
                "state_dict: the batches went through DataLoader workers, and this process does not know which of them "
                "were used; save Batch.resume_state of the last batch you trained on instead"
            )
        return self._here or _next_start(record, consumer)

    def load(self, saved: ResumeState, consumer: Consumer) -> None:
        """Start the next pass where ``saved`` was taken.

        Raises:
            UsageError: it is the state of another loader worker.
        """
        worker = get_worker_info()
        _require_share(saved, worker, consumer)
        state = consumer.adopt(saved)
        if worker is not None:
            self._here = self._loaded = state if state.share else _skip_rest(state, consumer)
            return
        with self._shared.change() as record:
            record.load(state)
            record.stale = False
        self._here = None

    def begin(self, consumer: Consumer) -> Iteration:
        """Begin a pass, or this loader worker's part of one. Older iterations no longer affect the position."""
        self._iterations += 1
        worker = get_worker_info()
        with self._shared.change() as record:
            start = _next_start(record, consumer)
            if start.place != record.start.state.place:
                record.start = Start(start, loaded=record.start.loaded)
            if worker is None:
                name, number, workers = None, 0, 1
            else:
                # PyTorch seeds the workers of a loader alike, and they iterate equally often.
                name, number, workers = f"{worker.seed - worker.id}:{self._iterations}", worker.id, worker.num_workers
            begun, repeats = record.begin(name, number, workers, self._loaded)
            state = consumer.adopt(dataclasses.replace(begun.start.state, stream=record.stream))
        self._loaded, self._newest, self._delivered = None, begun.number, 0
        done = begun.start.shares.get((number, workers), 0)
        iteration = Iteration(begun.number, state, number, workers, worker is not None, done, begun.looked + 1, repeats)
        self._here = state if worker is None else iteration.after(consumer, 0, state.quarantine)
        if done and state.stream is not None and not iteration.batches(consumer.plan(state.stream, state)):
            # A stateful loader may drop this iterator unused, but the epoch is over.
            self.finish(iteration)
        return iteration

    def pin(self, begun: Iteration, stream: StreamIdentity, address: str) -> Iteration:
        """Record the stream that a server offered to an iteration, and return the iteration with it.

        Raises:
            StateMismatch: a loader worker was offered another one before.
        """
        with self._shared.change() as record:
            first = record.stream = record.stream or stream
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
        if self._delivered <= begun.counts or last:
            with self._shared.change() as record:
                record.deliver(begun.number)
                if last:
                    record.finish(begun.number, begun.worker)

    def finish(self, begun: Iteration) -> None:
        """Record that an iteration has delivered all its batches, and was asked for one more."""
        if begun.number != self._newest:
            return
        with self._shared.change() as record:
            record.finish(begun.number, begun.worker)
        self._here = begun.state.at_epoch(begun.state.epoch + 1) if begun.in_loader else None


def _next_start(record: Record, consumer: Consumer) -> ResumeState:
    """Return where the next pass begins, in this world size."""
    state = consumer.adopt(dataclasses.replace(record.start.state, stream=record.stream))
    # set_epoch may name a loaded epoch of which less than a global batch is left: the next pass then has no batches.
    return state if record.start.named else _skip_rest(state, consumer)


def _skip_rest(state: ResumeState, consumer: Consumer) -> ResumeState:
    """Return the next epoch if less than a global batch is left of a resumed one; otherwise ``state``."""
    if state.is_beginning or consumer.has_batches(state):
        return state
    return state.at_epoch(state.epoch + 1)


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
