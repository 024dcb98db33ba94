"""Counts what a consumer missed or got twice. Pure, and independent of the client's own bookkeeping.

The schedule of one rank of one: the batches of an epoch are samples [0, b), [b, 2b) ... as long as whole batches fit
into its N sequences; then comes the next epoch. So the pair (epoch, index) has the ordinal

    (epoch - first epoch) b floor(N / b) + index

and a faultless consumer sees the ordinals 0, 1, 2 ... in this order.
"""

from __future__ import annotations

from collections.abc import Iterable


class ScheduleCheck:
    """
    Args:
        sequences: N.
        batch_size: b.
        first_epoch: the epoch that was consumed first, from its beginning.

    Attributes:
        duplicated: samples that came again.
        foreign: samples that are not in the schedule at all.
        out_of_order: samples that did not follow their predecessor.
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
        """Samples that should have come before the furthest one that did."""
        return self._highest + 1 - self._complete - len(self._beyond)

    @property
    def faultless(self) -> bool:
        """Each sample once, in order."""
        return not (self.lost or self.duplicated or self.foreign or self.out_of_order)

    def observe(self, epoch: int, indices: Iterable[int]) -> None:
        """One batch as it came."""
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
