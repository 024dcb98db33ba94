"""Where one copy of a dataset stands, and where its next iteration begins.

What all copies agree on is in :mod:`v2v_client.position.shared`. Here is what one of them knows beyond it: which of its
iterations is the newest, the state after the last batch that came out of it, and how far a loader worker had come that
a stateful loader restores.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from torch.utils.data import get_worker_info

from v2v_client.position.plan import Consumer, EpochPlan
from v2v_client.position.shared import Agreed, Shared
from v2v_client.position.state import ResumeState, StreamIdentity
from v2v_protocol.errors import UsageError

_NO_BATCH_YET = 0
_USED = 2
"""Batches of an iteration from which on it counts as training, not as a look at the data."""
_USED_BY_LOADER_WORKER = 4
"""The same for a loader worker, which prefetches two batches by default."""


@dataclass(frozen=True, slots=True)
class Iteration:
    """One iteration of a dataset, as it began.

    Attributes:
        number: which of this copy's.
        epoch: that it delivers.
        state: where in it; None at its beginning.
        beginnings: how often an epoch had been set or begun until then.
        shared: its number among those of loader workers; 0 where none of them iterates.
        worker, workers: which of how many loader workers; 0 of 1 where none iterates.
        done: batches of the loader worker's share that were delivered before.
        repeats: it is the first that repeats an iteration which was left early.
    """

    number: int
    epoch: int
    state: ResumeState | None
    beginnings: int = 0
    shared: int = 0
    worker: int = 0
    workers: int = 1
    done: int = _NO_BATCH_YET
    repeats: bool = False

    def batches(self, plan: EpochPlan) -> range:
        """Numbers of the batches that are still to be delivered here."""
        return plan.batches_of_worker(self.worker, self.workers)[self.done :]

    def after(
        self, consumer: Consumer, stream: StreamIdentity | None, done: int, quarantine: int | None = None
    ) -> ResumeState:
        """The state of its loader worker, which has delivered ``done`` batches of its share."""
        return consumer.in_share(
            stream,
            self.epoch,
            self.state,
            worker=self.worker,
            workers=self.workers,
            done=done,
            quarantine=quarantine,
        )


class Position:
    """Where this copy stands. A shallow copy shares the record, and moves on by itself."""

    def __init__(self, epoch: int) -> None:
        self._shared = Shared(epoch)
        self._iterations = 0
        self._here: ResumeState | None = None  # after the last batch of this process; None where the record says
        self._loaded: ResumeState | None = None  # of this loader worker, from a stateful loader
        self._to_start_from: ResumeState | None = None  # the same, until it iterates
        self._empty_rest: ResumeState | None = None  # what was loaded, where the next epoch was taken up instead

    def agreed(self) -> Agreed:
        """What the copies agree on now."""
        return self._shared.agreed()

    def set_epoch(self, epoch: int) -> None:
        """The next iteration delivers ``epoch``; from its beginning, unless a state of that epoch was loaded."""
        with self._shared.change() as agreed:
            state, rest = agreed.state if agreed.epoch == epoch else None, self._empty_rest
            if rest is not None and rest.epoch == epoch and self._is_at_the_beginning_of(epoch + 1, agreed):
                # Whoever loads a state and then names its epoch has had these samples: all of them, but for a rest.
                state = rest
            agreed.begin(epoch, state)
            agreed.stale = False
        self._here = None

    def _is_at_the_beginning_of(self, epoch: int, agreed: Agreed) -> bool:
        """Whether a state was loaded that begins there, and no batch has come out since."""
        return not agreed.stale and all(
            state is not None and (state.epoch, state.origin, state.position) == (epoch, 0, 0)
            for state in (self._here, agreed.state)
        )

    def state(self, consumer: Consumer) -> ResumeState:
        """After the last batch that this process took.

        Raises:
            UsageError: loader workers took the batches, so that this process does not know.
        """
        if self._here is not None and get_worker_info() is not None:
            return self._here
        agreed = self.agreed()
        if agreed.stale:
            raise UsageError(
                "state_dict: the batches went through DataLoader workers, and this process does not know which of them "
                "were used; save Batch.resume_state of the last batch you trained on instead"
            )
        return self._here or agreed.state or consumer.beginning(agreed.stream, agreed.epoch)

    def load(self, saved: ResumeState, consumer: Consumer) -> None:
        """The next iteration begins where ``saved`` was taken.

        Raises:
            UsageError: it is the state of a loader worker somewhere else.
        """
        loader = get_worker_info()
        consumer.require_share(saved, loader)
        state = consumer.taken_up(saved)
        self._here = state
        if loader is not None:
            self._loaded = self._to_start_from = state
            return
        self._empty_rest = consumer.rest(saved) if state.epoch > saved.epoch else None
        with self._shared.change() as agreed:
            agreed.begin(state.epoch, dataclasses.replace(state, share=None))
            agreed.stale = False

    def begin(self, consumer: Consumer) -> Iteration:
        """A new iteration; older ones say nothing about where we are from now on."""
        self._iterations += 1
        worker = get_worker_info()
        if worker is None:
            with self._shared.change() as agreed:
                agreed.stale = False
                repeats = agreed.repeats()
            self._here = agreed.state or consumer.beginning(agreed.stream, agreed.epoch)
            return Iteration(self._iterations, agreed.epoch, agreed.state, agreed.beginnings, repeats=repeats)
        with self._shared.change() as agreed:
            shared = agreed.start(self._name(worker), worker.id, self._to_start_from)
        self._to_start_from = None
        begun = Iteration(
            self._iterations,
            shared.epoch,
            shared.state,
            shared.beginnings,
            shared.number,
            worker.id,
            worker.num_workers,
            self._already_done(shared.epoch, shared.state),
            shared.repeats,
        )
        known = None if shared.state is None else shared.state.stream
        if known is not None and not begun.batches(consumer.plan(known, shared.state)) and begun.done > 0:
            # A stateful loader may discard this iterator unused; the epoch is over all the same.
            self.finish(begun, consumer)
        else:
            self._here = begun.after(consumer, agreed.stream, begun.done)
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

    def pin(self, stream: StreamIdentity, address: str) -> None:
        """A server offered ``stream`` where none was known.

        Raises:
            StateMismatch: a loader worker beside us was offered another one first.
        """
        with self._shared.change() as agreed:
            first = agreed.stream = agreed.stream or stream
        first.require_same(stream, ours="another loader worker", theirs=address)

    def reached(self, begun: Iteration, state: ResumeState, *, count: int, last: bool) -> None:
        """A batch comes out of an iteration now.

        Args:
            state: the one after it.
            count: batches that came out of this iteration so far, this one included.
            last: whether it is the last one: who counts batches may never ask whether there is another.
        """
        if begun.number == self._iterations:  # an older iterator that is still read says nothing about where we are
            self._here = state
            if count == (_USED_BY_LOADER_WORKER if begun.shared else _USED):
                with self._shared.change() as agreed:
                    agreed.used = begun.beginnings
            if last:
                self._finish(begun)

    def finish(self, begun: Iteration, consumer: Consumer) -> None:
        """An iteration has delivered all its batches, and was asked for one more."""
        if begun.number != self._iterations:
            return
        self._finish(begun)
        self._here = consumer.beginning(self.agreed().stream, begun.epoch + 1) if begun.shared else None

    def _finish(self, begun: Iteration) -> None:
        with self._shared.change() as agreed:
            if begun.shared:
                agreed.finish(begun.shared, begun.worker, begun.workers)
            elif agreed.beginnings == begun.beginnings:  # otherwise an epoch was set since: that is the next
                agreed.begin(begun.epoch + 1, None)
