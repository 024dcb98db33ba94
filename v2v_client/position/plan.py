"""Compute which samples a rank and a loader worker take of an epoch. Pure arithmetic.

    global index of rank r of W at local position p  =  origin + p W + r
    batch k of a rank                                =  local positions [position + k b, position + (k + 1) b)
    loader worker w of Wl                            =  batches w, w + Wl, w + 2 Wl ...

``origin`` is 0 unless an epoch was resumed with another world size. Positions count samples, so a resumed epoch may use
any batch size. Ranks that are all at local position p have together consumed [0, origin + p W). Another world size can
continue there, and only there, by counting from that origin. A state taken after a batch is such a place, because every
rank has as many batches as the others.

The samples after the last whole global batch of W b samples are dropped; a shuffled epoch drops others each time.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from v2v_client.position.state import ResumeState, StreamIdentity
from v2v_protocol.errors import UsageError


@dataclass(frozen=True, slots=True)
class EpochPlan:
    """Hold one rank's batches of one epoch, counted from where the epoch was started or resumed.

    Attributes:
        sequences: N, samples of the epoch.
        world_size, rank: W and r.
        batch_size: b, samples of one rank's batch.
        origin: global index that local positions count from.
        position: local samples that this rank has consumed before the first batch of the plan.

    Raises:
        UsageError: a number is outside its range.
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
        """Return the number of batches of this rank from its position to the end; it is equal for all ranks."""
        of_rank = (self.sequences - self.origin) // self.world_size
        return (of_rank - self.position) // self.batch_size

    def indices(self, batch: int) -> tuple[int, ...]:
        """Return the global indices of the samples of batch ``batch``, in order."""
        first = self.position + batch * self.batch_size
        return tuple(
            self.origin + position * self.world_size + self.rank for position in range(first, first + self.batch_size)
        )

    def position_after(self, batch: int) -> int:
        """Return the number of local samples consumed after batch ``batch``."""
        return self.position + (batch + 1) * self.batch_size

    def batches_of_worker(self, worker: int, workers: int) -> range:
        """Return the numbers of the batches that one of ``workers`` loader workers takes.

        Raises:
            UsageError: no such worker.
        """
        if not 0 <= worker < workers:
            raise UsageError(f"loader worker {worker} of {workers}: workers are 0 .. {workers - 1}")
        return range(worker, self.batches, workers)

    def shares_decodes(self, spacing: int, workers: int) -> bool:
        """Return whether all siblings, ``spacing`` apart in the epoch, go to the same loader worker of the same rank.

        Raises:
            UsageError: two siblings could be in one global batch.
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
        """Check that the epoch holds at least one global batch.

        Raises:
            UsageError: it does not.
        """
        if self.batches < 1:
            raise UsageError(
                f"an epoch of {self.sequences} sequences holds no global batch of {self.world_size} x "
                f"{self.batch_size} = {self.world_size * self.batch_size} samples (world size x batch_size); use a "
                "smaller batch_size, fewer ranks or more videos"
            )


@dataclass(frozen=True, slots=True)
class Consumer:
    """Convert between a rank's states and its batches.

    Attributes:
        batch_size: samples of one rank's batch.
        rank, world_size: of this process.
    """

    batch_size: int
    rank: int
    world_size: int

    def plan(self, stream: StreamIdentity, state: ResumeState) -> EpochPlan:
        """Return the batches of an epoch from ``state`` on."""
        return EpochPlan(stream.sequences, self.world_size, self.rank, self.batch_size, state.origin, state.position)

    def after(self, state: ResumeState, plan: EpochPlan, batch: int, quarantine: int | None) -> ResumeState:
        """Return the rank's state after a batch. After the last one, it is the beginning of the next epoch.

        Args:
            state: where the plan begins.
            batch: number of the batch in the plan.
            quarantine: newest quarantine snapshot seen.
        """
        if batch + 1 == plan.batches:
            return state.at_epoch(state.epoch + 1)
        return dataclasses.replace(state, position=plan.position_after(batch), share=None, quarantine=quarantine)

    def adopt(self, state: ResumeState) -> ResumeState:
        """Return ``state`` for this world size; another one counts from the first index that no rank consumed."""
        if state.world_size == self.world_size:
            return state
        origin = state.origin + state.position * state.world_size
        return dataclasses.replace(state, origin=origin, position=0, world_size=self.world_size)

    def has_batches(self, state: ResumeState) -> bool:
        """Return whether a batch is left after ``state``; True if the stream is not known."""
        return state.stream is None or self.plan(state.stream, state).batches > 0
