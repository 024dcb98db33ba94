"""Where one copy of a dataset stands: its state, and where its next iteration begins.

What all copies of a dataset agree on (the original, and one in each loader worker) is in their log,
:mod:`v2v_client.position.progress`. Here is what one of them knows beyond it: which of its iterations is the newest,
the state after the last batch that came out of it, and how far a loader worker had come that a stateful loader
restores.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from torch.utils.data import get_worker_info

from v2v_client.position.progress import Progress, Standing
from v2v_client.position.state import LoaderShare, ResumeState, Stream
from v2v_client.position.world import EpochPlan, resumed
from v2v_protocol.errors import UsageError

_NO_BATCH_YET = 0


@dataclass(frozen=True, slots=True)
class Loader:
    """The loader worker that iterates.

    Attributes:
        worker, workers: which of how many.
        iteration: a name that the loader workers of one iteration share.
        number: which start of that iteration this is.
    """

    worker: int
    workers: int
    iteration: str
    number: int


@dataclass(frozen=True, slots=True)
class Iteration:
    """One iteration of a dataset, as it began.

    Attributes:
        number: which of this copy's.
        epoch: that it delivers.
        state: where in it; None at its beginning.
        loader: None where no loader worker iterates.
        done: batches of the loader worker's share that were delivered before.
        beginnings: how often an epoch had been set or begun until then; of no use with a loader worker.
    """

    number: int
    epoch: int
    state: ResumeState | None
    loader: Loader | None = None
    done: int = _NO_BATCH_YET
    beginnings: int = 0

    @property
    def workers(self) -> int:
        """Loader workers that share the epoch; 1 without."""
        return 1 if self.loader is None else self.loader.workers

    def batches(self, plan: EpochPlan) -> range:
        """Numbers of the batches that are still to be delivered here."""
        worker = 0 if self.loader is None else self.loader.worker
        return plan.batches_of_worker(worker, self.workers)[self.done :]


@dataclass(frozen=True, slots=True)
class Consumer:
    """One rank's part in a stream: what turns places in it into states.

    Attributes:
        seed: of the stream.
        batch_size: samples of one rank's batch.
        rank, world_size: which of how many.
    """

    seed: int
    batch_size: int
    rank: int
    world_size: int

    def plan(self, stream: Stream, state: ResumeState | None) -> EpochPlan:
        """The batches of an epoch from ``state`` on; from its beginning without."""
        origin, position = (0, 0) if state is None else (state.origin, state.position)
        return EpochPlan(stream.sequences, self.world_size, self.rank, self.batch_size, origin, position)

    def beginning(self, stream: Stream | None, epoch: int) -> ResumeState:
        """The state before an epoch."""
        return ResumeState(stream, self.seed, epoch, 0, 0, self.world_size)

    def after(self, stream: Stream, epoch: int, plan: EpochPlan, batch: int, quarantine: int | None) -> ResumeState:
        """The rank's state after a batch; after the last one, that is the beginning of the next epoch."""
        if batch + 1 == plan.batches:
            return self.beginning(stream, epoch + 1)
        position = plan.position_after(batch)
        return ResumeState(stream, self.seed, epoch, plan.origin, position, plan.world_size, quarantine=quarantine)

    def in_share(
        self, stream: Stream | None, begun: Iteration, loader: Loader, done: int, quarantine: int | None = None
    ) -> ResumeState:
        """The state of a loader worker that has delivered ``done`` batches of its share."""
        origin, position = (0, 0) if begun.state is None else (begun.state.origin, begun.state.position)
        share = LoaderShare(loader.worker, loader.workers, self.batch_size, done)
        return ResumeState(stream, self.seed, begun.epoch, origin, position, self.world_size, share, quarantine)

    def rest(self, saved: ResumeState) -> ResumeState:
        """A saved state under this world size; its epoch may hold no whole global batch any more."""
        origin, position = resumed(
            origin=saved.origin,
            position=saved.position,
            saved_world_size=saved.world_size,
            world_size=self.world_size,
        )
        return dataclasses.replace(saved, origin=origin, position=position, world_size=self.world_size)

    def taken_up(self, saved: ResumeState) -> ResumeState:
        """A saved state under this world size; where nothing but what an epoch drops is left, the next epoch."""
        state = self.rest(saved)
        begun = state.position + state.origin > 0
        if begun and state.stream is not None and self.plan(state.stream, state).batches == 0:
            return dataclasses.replace(state, epoch=state.epoch + 1, origin=0, position=0, share=None)
        return state

    def require_share(self, state: ResumeState, loader: Any) -> None:
        """
        Args:
            loader: PyTorch's description of the loader worker that this process is; None if it is none.

        Raises:
            UsageError: the state is that of a loader worker, and not of this one.
        """
        share = state.share
        here = None if loader is None else (loader.id, loader.num_workers, self.batch_size, self.world_size)
        if share is None or here == (share.worker, share.workers, share.batch_size, state.world_size):
            return
        raise UsageError(
            f"this is the state of loader worker {share.worker} of {share.workers} (batch_size {share.batch_size}, "
            f"world size {state.world_size}); only the same worker of an equal loader can go on from it. "
            "Batch.resume_state holds for any number of loader workers"
        )


class Position:
    """Where this copy stands. A shallow copy shares the log, and moves on by itself."""

    def __init__(self, epoch: int) -> None:
        self._progress = Progress(epoch)
        self._iterations = 0
        self._here: ResumeState | None = None  # after the last batch of this process; None where the log says
        self._loaded: ResumeState | None = None  # of this loader worker, from a stateful loader
        self._empty_rest: ResumeState | None = None  # what was loaded, where the next epoch was taken up instead

    def standing(self) -> Standing:
        """What the copies agree on now."""
        return self._progress.standing()

    def set_epoch(self, epoch: int) -> None:
        """The next iteration delivers ``epoch``; from its beginning, unless a state of that epoch was loaded."""
        standing, rest = self.standing(), self._empty_rest
        state = standing.state if standing.epoch == epoch else None
        if rest is not None and rest.epoch == epoch and self._is_at_the_beginning_of(epoch + 1, standing):
            # Whoever loads a state and then names its epoch has had these samples: all of them, but for a rest.
            state = rest
        self._progress.set(epoch, state)
        self._here = None

    def _is_at_the_beginning_of(self, epoch: int, standing: Standing) -> bool:
        """Whether a state was loaded that begins there, and no batch has come out since."""
        return not standing.stale and all(
            state is not None and (state.epoch, state.origin, state.position) == (epoch, 0, 0)
            for state in (self._here, standing.state)
        )

    def state(self, consumer: Consumer) -> ResumeState:
        """After the last batch that this process took.

        Raises:
            UsageError: loader workers took the batches, so that this process does not know.
        """
        if self._here is not None and get_worker_info() is not None:
            return self._here
        standing = self.standing()
        if standing.stale:
            raise UsageError(
                "state_dict: the batches went through DataLoader workers, and this process does not know which of them "
                "were used; save Batch.resume_state of the last batch you trained on instead"
            )
        return self._here or standing.state or consumer.beginning(standing.stream, standing.epoch)

    def load(self, saved: ResumeState, consumer: Consumer) -> None:
        """The next iteration begins where ``saved`` was taken.

        Raises:
            UsageError: it is the state of a loader worker somewhere else.
        """
        loader = get_worker_info()
        consumer.require_share(saved, loader)
        state = consumer.taken_up(saved)
        shared = dataclasses.replace(state, share=None)
        if loader is None:
            self._progress.set(state.epoch, shared)
            self._empty_rest = consumer.rest(saved) if state.epoch > saved.epoch else None
        else:
            self._progress.set(state.epoch, shared, iteration=self._name(loader), worker=loader.id)
            self._loaded = state
        self._here = state

    def begin(self, consumer: Consumer) -> Iteration:
        """A new iteration; older ones say nothing about where we are from now on."""
        self._iterations += 1
        worker = get_worker_info()
        if worker is None:
            self._progress.main()
            standing = self.standing()
            self._here = standing.state or consumer.beginning(standing.stream, standing.epoch)
            return Iteration(self._iterations, standing.epoch, standing.state, beginnings=standing.beginnings)
        name = self._name(worker)
        number, epoch, state = self._progress.start(name, worker.id)
        loader = Loader(worker.id, worker.num_workers, name, number)
        begun = Iteration(self._iterations, epoch, state, loader, self._already_done(epoch, state))
        known = None if state is None else state.stream
        if known is not None and not begun.batches(consumer.plan(known, state)) and begun.done > 0:
            # A stateful loader may discard this iterator unused; the epoch is over all the same.
            self.finish(begun, consumer)
        else:
            self._here = consumer.in_share(self.standing().stream, begun, loader, begun.done)
        return begun

    def _name(self, worker: Any) -> str:
        """A name that the loader workers of one iteration share: PyTorch seeds them alike, and they iterate alike."""
        return f"{worker.seed - worker.id}:{self._iterations}"

    def _already_done(self, epoch: int, state: ResumeState | None) -> int:
        """Batches of this loader worker's share that a loaded state says it delivered."""
        loaded = self._loaded
        if loaded is None or loaded.share is None or state is None:
            return _NO_BATCH_YET
        here, there = (loaded.epoch, loaded.origin, loaded.position), (epoch, state.origin, state.position)
        return loaded.share.batches if here == there else _NO_BATCH_YET

    def pin(self, stream: Stream, address: str) -> None:
        """A server offered ``stream`` where none was known.

        Raises:
            StateMismatch: a loader worker beside us was offered another one first.
        """
        self._progress.pin(stream)
        first = self.standing().stream
        if first is not None:
            first.require_same(stream, ours="another loader worker", theirs=address)

    def reached(self, begun: Iteration, state: ResumeState, *, last: bool) -> None:
        """A batch comes out of an iteration now.

        Args:
            state: the one after it.
            last: whether it is the last one: who counts batches may never ask whether there is another.
        """
        if begun.number == self._iterations:  # an older iterator that is still read says nothing about where we are
            self._here = state
            if last:
                self._finish(begun)

    def finish(self, begun: Iteration, consumer: Consumer) -> None:
        """An iteration has delivered all its batches, and was asked for one more."""
        if begun.number != self._iterations:
            return
        self._finish(begun)
        self._here = None if begun.loader is None else consumer.beginning(self.standing().stream, begun.epoch + 1)

    def _finish(self, begun: Iteration) -> None:
        loader = begun.loader
        if loader is not None:
            self._progress.finish(loader.iteration, loader.number, loader.worker, loader.workers)
        elif self.standing().beginnings == begun.beginnings:  # otherwise an epoch was set since: that is the next
            self._progress.set(begun.epoch + 1, None)
