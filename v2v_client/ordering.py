"""The reorder window: samples arrive in any order, batches leave in theirs. Pure.

The window asks ahead in batch order. Two limits hold at any time:

    samples asked for and not received                      <= credit
    samples asked for and not yet part of a taken batch     <= credit + batch size

The second bounds memory while one late sample holds up its batch: at most ceil(credit / batch size) + 2 batches have
buffers. It leaves room for one whole batch however small the credit is, so the first batch can always be completed.

Samples that nobody asked for, and second copies, are counted and dropped: asking again after a cut can make them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from v2v_protocol.errors import LimitExceeded

_REQUESTS_A_CREDIT = 8
"""A request asks for at least this part of the credit; so much less of it is ever under way."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where a sample belongs: its batch, and the row in it."""

    batch: int
    row: int


class ReorderWindow:
    """Keeps account of the samples of one epoch, not of their bytes.

    Args:
        batches: numbers of the batches to deliver, in order.
        indices: global indices of the samples of a batch; every batch has as many, and none shares one.
        batch_size: how many those are.
        credit: most samples asked for and not received.

    Attributes:
        duplicates: arrivals of a sample that had come already.
        strays: arrivals of a sample that was never asked for.

    Raises:
        LimitExceeded: a credit of less than one sample.
    """

    def __init__(
        self, batches: Sequence[int], indices: Callable[[int], tuple[int, ...]], batch_size: int, credit: int
    ) -> None:
        if credit < 1:
            raise LimitExceeded(f"a credit of {credit} samples; nothing could ever be asked for")
        self._batches = batches
        self._indices = indices
        self._batch_size = batch_size
        self._credit = credit
        self._asking = 0  # place in ``batches`` of the batch being asked for
        self._unasked: list[int] = []  # the rest of that batch, next one last
        self._taken = 0  # batches delivered
        self._places: dict[int, Place] = {}  # samples asked for, until their batch is taken
        self._outstanding: dict[int, None] = {}  # of those, the ones not received, in the order asked
        self._missing: dict[int, int] = {}  # batch -> rows not received
        self.duplicates = 0
        self.strays = 0

    @property
    def finished(self) -> bool:
        """Every batch was taken."""
        return self._taken == len(self._batches)

    @property
    def outstanding(self) -> tuple[int, ...]:
        """Samples asked for and not received, in the order asked."""
        return tuple(self._outstanding)

    def ask(self) -> tuple[int, ...]:
        """What to ask for now, within both limits; it counts as asked for from here on.

        Nothing as long as it is little and some is under way: a request for every sample that arrives would cost the
        server as much as the sample does.
        """
        asked: list[int] = []
        room = min(
            self._credit - len(self._outstanding),
            self._credit + self._batch_size - len(self._places),
        )
        if room < self._credit // _REQUESTS_A_CREDIT and self._outstanding:
            return ()
        while len(asked) < room:
            if not self._unasked and not self._begin_batch():
                break
            index = self._unasked.pop()
            batch = self._batches[self._asking - 1]
            self._places[index] = Place(batch, self._batch_size - len(self._unasked) - 1)
            self._outstanding[index] = None
            asked.append(index)
        return tuple(asked)

    def _begin_batch(self) -> bool:
        if self._asking == len(self._batches):
            return False
        batch = self._batches[self._asking]
        self._unasked = list(reversed(self._indices(batch)))
        self._missing[batch] = len(self._unasked)
        self._asking += 1
        return True

    def place(self, index: int) -> Place:
        """Where a sample belongs that was asked for."""
        return self._places[index]

    def receive(self, index: int) -> Place | None:
        """A sample arrived: the place of its bytes, or None when it is to be dropped."""
        if index not in self._outstanding:
            # A sample of a batch that left is a second copy too, but remembering all of those would cost memory
            # without end; it counts as one that nobody asks for.
            if index in self._places:
                self.duplicates += 1
            else:
                self.strays += 1
            return None
        del self._outstanding[index]
        place = self._places[index]
        self._missing[place.batch] -= 1
        return place

    def take(self) -> int | None:
        """The number of the next batch, if it is complete; it leaves the window."""
        if self.finished:
            return None
        batch = self._batches[self._taken]
        if self._missing.get(batch) != 0:
            return None
        del self._missing[batch]
        for index in self._indices(batch):
            del self._places[index]
        self._taken += 1
        return batch
