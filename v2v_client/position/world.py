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

from dataclasses import dataclass

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
