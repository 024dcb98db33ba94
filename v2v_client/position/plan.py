"""Which samples a rank and a loader worker take of an epoch. Pure arithmetic.

    global index of rank r of W at local position p  =  origin + p W + r
    batch k of a rank                                =  local positions [position + k b, position + (k + 1) b)
    loader worker w of Wl                            =  batches w, w + Wl, w + 2 Wl ...

``origin`` is 0 but where an epoch was resumed with another world size. Positions count samples, so another batch size
is exact anywhere. Ranks that are all at local position p have together consumed [0, origin + p W): there, and only
there, another world size can take over, by counting from that origin. A state taken after a batch is such a place,
because every rank has as many batches as the others.

What is left after the last whole global batch of W b samples is dropped; a shuffled epoch drops others each time.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from v2v_client.position.state import LoaderShare, ResumeState, StreamIdentity
from v2v_protocol.errors import UsageError


@dataclass(frozen=True, slots=True)
class EpochPlan:
    """One rank's batches of one epoch, counted from where the epoch was started or resumed.

    Attributes:
        sequences: N, samples of the epoch.
        world_size, rank: W and r.
        batch_size: b, samples of one rank's batch.
        origin: global index that local positions count from.
        position: local samples this rank has consumed before the first batch of the plan.

    Raises:
        UsageError: a number outside its range.
    """

    sequences: int
    world_size: int = 1
    rank: int = 0
    batch_size: int = 1
    origin: int = 0
    position: int = 0

    def __post_init__(self) -> None:
        if self.world_size < 1 or not 0 <= self.rank < self.world_size:
            raise UsageError(f"rank {self.rank} of world size {self.world_size}: ranks are 0 .. world size - 1")
        if self.batch_size < 1:
            raise UsageError(f"batch_size = {self.batch_size}: give 1 or more")
        consumed = self.origin + self.position * self.world_size
        if min(self.origin, self.position) < 0 or consumed > self.sequences:
            raise UsageError(
                f"position {self.position} of {self.world_size} ranks from global index {self.origin} is outside an "
                f"epoch of {self.sequences} sequences"
            )

    @property
    def batches(self) -> int:
        """Batches of this rank from its position to the end of the epoch; equal for all ranks."""
        of_rank = (self.sequences - self.origin) // self.world_size
        return (of_rank - self.position) // self.batch_size

    def indices(self, batch: int) -> tuple[int, ...]:
        """Global indices of the samples of batch ``batch``, in order."""
        first = self.position + batch * self.batch_size
        return tuple(
            self.origin + position * self.world_size + self.rank for position in range(first, first + self.batch_size)
        )

    def position_after(self, batch: int) -> int:
        """Local samples consumed once batch ``batch`` is."""
        return self.position + (batch + 1) * self.batch_size

    def batches_of_worker(self, worker: int, workers: int) -> range:
        """Numbers of the batches that one of ``workers`` loader workers takes.

        Raises:
            UsageError: no such worker.
        """
        if not 0 <= worker < workers:
            raise UsageError(f"loader worker {worker} of {workers}: workers are 0 .. {workers - 1}")
        return range(worker, self.batches, workers)

    def shares_decodes(self, spacing: int, workers: int) -> bool:
        """Whether all siblings, ``spacing`` apart in the epoch, go to the same loader worker of the same rank.

        Raises:
            UsageError: two of them could be in one global batch.
        """
        together = self.world_size * self.batch_size
        if spacing < together:
            raise UsageError(
                f"sibling_spacing = {spacing}: samples of one decode would come in one global batch of "
                f"{self.world_size} x {self.batch_size} = {together} samples (world size x batch_size); use a smaller "
                "batch_size, or begin a new stream"
            )
        return spacing % (together * workers) == 0

    def require_batches(self) -> None:
        """
        Raises:
            UsageError: the epoch is smaller than one global batch.
        """
        if self.batches < 1:
            raise UsageError(
                f"an epoch of {self.sequences} sequences holds no global batch of {self.world_size} x "
                f"{self.batch_size} = {self.world_size * self.batch_size} samples (world size x batch_size); use a "
                "smaller batch_size, fewer ranks or more videos"
            )


def resumed(*, origin: int, position: int, saved_world_size: int, world_size: int) -> tuple[int, int]:
    """Origin and position under ``world_size`` of what ``saved_world_size`` ranks had consumed.

    Equal world sizes keep both; another one counts anew from the first global index that nobody consumed.
    """
    if world_size == saved_world_size:
        return origin, position
    return origin + position * saved_world_size, 0


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

    def plan(self, stream: StreamIdentity, state: ResumeState | None) -> EpochPlan:
        """The batches of an epoch from ``state`` on; from its beginning without."""
        origin, position = (0, 0) if state is None else (state.origin, state.position)
        return EpochPlan(stream.sequences, self.world_size, self.rank, self.batch_size, origin, position)

    def beginning(self, stream: StreamIdentity | None, epoch: int) -> ResumeState:
        """The state before an epoch."""
        return ResumeState(stream, self.seed, epoch, 0, 0, self.world_size)

    def after(
        self, stream: StreamIdentity, epoch: int, plan: EpochPlan, batch: int, quarantine: int | None
    ) -> ResumeState:
        """The rank's state after a batch; after the last one, that is the beginning of the next epoch."""
        if batch + 1 == plan.batches:
            return self.beginning(stream, epoch + 1)
        position = plan.position_after(batch)
        return ResumeState(stream, self.seed, epoch, plan.origin, position, plan.world_size, quarantine=quarantine)

    def in_share(
        self,
        stream: StreamIdentity | None,
        epoch: int,
        begun: ResumeState | None,
        *,
        worker: int,
        workers: int,
        done: int,
        quarantine: int | None = None,
    ) -> ResumeState:
        """The state of a loader worker that has delivered ``done`` batches of its share since ``begun``."""
        origin, position = (0, 0) if begun is None else (begun.origin, begun.position)
        share = LoaderShare(worker, workers, self.batch_size, done)
        return ResumeState(stream, self.seed, epoch, origin, position, self.world_size, share, quarantine)

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
