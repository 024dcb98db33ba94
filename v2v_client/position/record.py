"""Record where the next pass begins, and which passes have begun. Pure.

The rules are in :mod:`v2v_client.position.position`.

Passes of loader workers have a name that their workers share, because a worker may begin late: after its siblings have
delivered batches, or after the dataset was told to go elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from v2v_client.position.state import ResumeState, StreamIdentity
from v2v_protocol.errors import UsageError

_MOST_PASSES = 8
"""Passes that are remembered. Loader workers may still join and finish them."""
_PREFETCHED = 2
"""Batches that each loader worker prefetches by default."""
_LOOKS = 2
"""Passes of any length that may begin at one place without a warning."""


@dataclass(slots=True)
class Start:
    """Hold a place where passes begin.

    Attributes:
        state: the place; its ``share`` is None.
        shares: batches that loader worker w of W has delivered from there, as {(w, W): batches}, if a stateful loader
            restored them.
        loaded: whether a saved state put the start there.
        named: whether :meth:`Record.set_epoch` named its epoch.
        passes: number of passes that began there.
        used: whether one of them delivered more batches than looking at the data takes.
    """

    state: ResumeState
    shares: dict[tuple[int, int], int] = field(default_factory=dict)
    loaded: bool = False
    named: bool = False
    passes: int = 0
    used: bool = False


@dataclass(slots=True)
class Pass:
    """Hold one iteration of the dataset.

    Attributes:
        number: unique in the record.
        name: known to the loader workers of the pass; two passes have the same one if a loader is restored twice with
            the same seeds. None for a pass of one process.
        start: where it began.
        workers: number of processes that share its batches.
        started, finished: numbers of these processes.
        delivered: batches, counted until ``start.used``.
    """

    number: int
    name: str | None
    start: Start
    workers: int
    started: set[int] = field(default_factory=set)
    finished: set[int] = field(default_factory=set)
    delivered: int = 0

    @property
    def looked(self) -> int:
        """Return the largest number of batches made for a loop that takes one batch."""
        return 1 if self.name is None else _PREFETCHED * self.workers + 1


@dataclass(slots=True)
class Record:
    """Hold what all copies of a dataset agree on.

    Attributes:
        start: where the next pass begins.
        stream: what the samples are made of, once known.
        stale: whether loader workers have begun a pass since the original dataset last knew where it stood.
        warned: whether a pass has already warned that it repeats samples.
        numbers: passes so far.
        passes: the newest passes, the newest last.
    """

    start: Start
    stream: StreamIdentity | None = None
    stale: bool = False
    warned: bool = False
    numbers: int = 0
    passes: list[Pass] = field(default_factory=list)

    def set_epoch(self, epoch: int) -> None:
        """Start the next pass at ``epoch``: at the loaded position, if that is in ``epoch``, else at its beginning.

        Raises:
            UsageError: a state of a later epoch was loaded, and nothing has been delivered from it.
        """
        state, shares = self.start.state, self.start.shares
        if self.start.loaded and not self.start.passes and epoch < state.epoch:
            raise UsageError(
                f"set_epoch({epoch}): the loaded state is in epoch {state.epoch}, and samples of earlier epochs would "
                f"be repeated; count epochs from dataset.epoch after a resume. accelerate's prepare() counts from 0: "
                "leave the loader out of prepare(), and use batch.to(accelerator.device)"
            )
        if epoch == state.epoch:
            self.start = Start(state, shares, named=True)
        else:
            self.start = Start(state.at_epoch(epoch), named=True)
        self.stale = False

    def load(self, state: ResumeState) -> None:
        """Start the next pass where ``state`` was taken."""
        self.start = Start(replace(state, share=None), loaded=True)
        self.stream = state.stream or self.stream

    def begin(
        self, name: str | None, worker: int, workers: int, loaded: ResumeState | None = None
    ) -> tuple[Pass, bool]:
        """Begin a pass, or join the one of that name if this worker has not joined it yet.

        Args:
            name: of the pass; None begins a pass of this process alone.
            worker, workers: which process of how many.
            loaded: the state that this loader worker was restored to. That of the first worker decides for all.

        Returns:
            the pass, and whether this worker is to warn that it repeats samples.
        """
        self.stale = name is not None
        found = next((item for item in reversed(self.passes) if name is not None and item.name == name), None)
        repeats = False
        if found is None or worker in found.started:
            if loaded is not None:
                self.load(loaded)
            start = self.start
            repeats = (start.used or start.passes >= _LOOKS) and not self.warned
            self.warned = self.warned or repeats
            start.passes += 1
            self.numbers += 1
            found = Pass(self.numbers, name, start, workers)
            self.passes = [*self.passes, found][-_MOST_PASSES:]
        found.started.add(worker)
        if loaded is not None and loaded.share is not None and loaded.place == found.start.state.place:
            found.start.shares[worker, workers] = loaded.share.batches
        return found, repeats

    def deliver(self, number: int) -> None:
        """Count a batch of a pass."""
        for item in self.passes:
            if item.number == number:
                item.delivered += 1
                item.start.used = item.start.used or item.delivered > item.looked

    def finish(self, number: int, worker: int) -> None:
        """Record that a process has delivered its batches of a pass. The last one makes the start of the next epoch.

        If the start has changed since the pass began, it stays.
        """
        for item in self.passes:
            if item.number == number:
                item.finished.add(worker)
                if len(item.finished) == item.workers and item.start is self.start:
                    state = self.start.state
                    self.start = Start(state.at_epoch(state.epoch + 1))
