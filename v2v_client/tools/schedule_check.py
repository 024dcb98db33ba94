"""Count samples that a consumer missed or got twice. Pure, and independent of the client's own bookkeeping.

With a single rank, the batches of an epoch are samples [0, b), [b, 2b) ... while whole batches fit into its N
sequences; then the next epoch follows. So the pair (epoch, index) has the ordinal

    (epoch - first epoch) b floor(N / b) + index

and a correct consumer receives the ordinals 0, 1, 2 ... in this order.
"""

from __future__ import annotations

from collections.abc import Iterable


class ScheduleCheck:
    """Count lost, repeated, unexpected and misplaced samples.

    Args:
        sequences: N, the sequences of an epoch.
        batch_size: b, the samples of a batch.
        first_epoch: the epoch consumed first, from its beginning.

    Attributes:
        duplicated: number of samples that came again.
        foreign: number of samples that are not in the schedule.
        out_of_order: number of samples that did not follow their predecessor.
    """

    def __init__(self, sequences: int, batch_size: int, first_epoch: int) -> None:
        self._per_epoch = sequences // batch_size * batch_size
        self._first_epoch = first_epoch
        self._complete = 0  # every ordinal below was seen
        self._beyond: set[int] = set()  # ordinals seen above the first gap
        self._previous = -1
        self._highest = -1
        self.duplicated = 0
        self.foreign = 0
        self.out_of_order = 0

    @property
    def lost(self) -> int:
        """Return the number of missing samples before the last one received."""
        return self._highest + 1 - self._complete - len(self._beyond)

    @property
    def faultless(self) -> bool:
        """Return whether each sample came once and in order."""
        return not (self.lost or self.duplicated or self.foreign or self.out_of_order)

    def observe(self, epoch: int, indices: Iterable[int]) -> None:
        """Record a received batch."""
        for index in indices:
            if epoch < self._first_epoch or not 0 <= index < self._per_epoch:
                self.foreign += 1
                continue
            ordinal = (epoch - self._first_epoch) * self._per_epoch + index
            self.out_of_order += ordinal != self._previous + 1
            self._previous = ordinal
            if ordinal < self._complete or ordinal in self._beyond:
                self.duplicated += 1
                continue
            self._highest = max(self._highest, ordinal)
            self._beyond.add(ordinal)
            while self._complete in self._beyond:
                self._beyond.remove(self._complete)
                self._complete += 1
