"""Assemble samples into batches: rows are filled in any order, and batches leave in order.

The :class:`ReorderWindow` (pure) requests samples ahead in batch order. Two limits hold at any time:

    samples requested and not received                      <= credit
    samples requested and not yet part of a taken batch     <= credit + batch size

The second bounds memory while one late sample delays its batch: at most ceil(credit / batch size) + 2 batches have
buffers. It always leaves space for one whole batch, so even with a small credit the first batch can be completed.

Samples that were not requested, and second copies, are dropped. Requests repeated after a disconnect can
cause both.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import NamedTuple

import torch

from v2v_client.batch import Batch
from v2v_client.connection import Connection
from v2v_client.conversation import Arrival
from v2v_client.memory import BatchBuffers, BatchMemory
from v2v_client.position import EpochPlan, ResumeState
from v2v_protocol.errors import LimitExceeded
from v2v_protocol.messages import SampleHeader

_REQUESTS_A_CREDIT = 8
"""A request asks for at least 1/8 of the credit, so up to 1/8 of the credit may stay unused."""


class Place(NamedTuple):
    """Hold where a sample belongs: the number of its batch, and the row in it."""

    batch: int
    row: int


class ReorderWindow:
    """Track which samples of one epoch are requested and received, without their bytes.

    Args:
        batches: numbers of the batches to deliver, in order.
        indices: returns the global indices of a batch's samples; batches are disjoint.
        batch_size: samples in each batch.
        credit: maximum number of samples requested and not received.

    Attributes:
        outstanding: the samples requested and not received, in the order of the requests.

    Raises:
        LimitExceeded: the credit is below 1.
    """

    def __init__(
        self, batches: Sequence[int], indices: Callable[[int], tuple[int, ...]], batch_size: int, credit: int
    ) -> None:
        if credit < 1:
            raise LimitExceeded(f"credit = {credit} samples: at least 1 is needed to request any")
        self._batches = batches
        self._indices = indices
        self._batch_size = batch_size
        self._credit = credit
        self._unasked = ((index, Place(batch, row)) for batch in batches for row, index in enumerate(indices(batch)))
        self._taken = 0  # batches delivered
        self._places: dict[int, Place] = {}  # samples asked for, until their batch is taken
        self.outstanding: dict[int, None] = {}
        self._received: Counter[int] = Counter()  # samples received of each batch, until it is taken

    @property
    def finished(self) -> bool:
        """Return whether every batch was taken."""
        return self._taken == len(self._batches)

    def ask(self) -> tuple[int, ...]:
        """Return the indices to request now, within both limits. They count as requested from here on.

        Returns no indices while there are only few and other samples are under way: one request per arriving sample
        would cost the server as much as the sample does.
        """
        allowed = min(
            self._credit - len(self.outstanding),
            self._credit + self._batch_size - len(self._places),
        )
        if allowed < self._credit // _REQUESTS_A_CREDIT and self.outstanding:
            return ()
        asked = dict(islice(self._unasked, allowed))
        self._places |= asked
        self.outstanding |= dict.fromkeys(asked)
        return tuple(asked)

    def place(self, index: int) -> Place:
        """Return where a requested sample belongs."""
        return self._places[index]

    def receive(self, index: int) -> Place | None:
        """Record an arrived sample and return its place, or None if it must be dropped."""
        if index not in self.outstanding:
            return None
        del self.outstanding[index]
        place = self._places[index]
        self._received[place.batch] += 1
        return place

    def take(self) -> int | None:
        """Remove the next batch from the window and return its number; None if it is not complete."""
        if self.finished:
            return None
        batch = self._batches[self._taken]
        if self._received[batch] < self._batch_size:
            return None
        del self._received[batch]
        for index in self._indices(batch):
            del self._places[index]
        self._taken += 1
        return batch


@dataclass(slots=True)
class _PartialBatch:
    """Hold a batch that is being filled: its memory, and the header of each sample received."""

    memory: BatchMemory
    headers: dict[int, SampleHeader] = field(default_factory=dict)  # by row
    is_local: bool = False  # whether any sample came in memory of this host


def deliver(
    connection: Connection,
    plan: EpochPlan,
    batches: Sequence[int],
    epoch: int,
    resume_state: Callable[[int, int], ResumeState],
    buffers: BatchBuffers,
    *,
    shared_memory: bool = True,
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[Batch]:
    """Yield the batches of an open connection, in order.

    Args:
        plan: defines which samples make up a batch.
        batches: numbers of the batches to deliver.
        resume_state: returns the state after a batch, given its number and the newest quarantine snapshot seen up to
            it.
        buffers: reusable memory for the batches.
        shared_memory: whether workers on this host may write samples into memory of this process.
        clock: seconds, for ``Batch.wait_seconds``.

    Raises:
        see :meth:`Connection.receive`.
    """
    conversation = connection.conversation
    window = ReorderWindow(batches, plan.indices, plan.batch_size, conversation.credit)
    most_partial = -(-conversation.credit // plan.batch_size) + 2
    # One more for the batch that the trainer holds: all of them are free when an epoch ends.
    buffers.shape(conversation.layout, plan.batch_size, spare=most_partial + 1)
    partial: dict[int, _PartialBatch] = {}
    quarantine, lend = 0, shared_memory
    recipe = conversation.stream.resolved.recipe

    def ask() -> None:
        asked, slots = window.ask(), {}
        for index in asked:
            place = window.place(index)
            if place.batch not in partial:
                partial[place.batch] = _PartialBatch(buffers.take(shared=lend))
            slot = partial[place.batch].memory.slot(place.row)
            if slot is not None:
                slots[index] = slot
        connection.want(asked, slots)

    def accept(sample: Arrival) -> None:
        place = window.receive(sample.header.index)
        if place is not None:
            batch = partial[place.batch]
            batch.memory.fill(place.row, sample.arrays, slot_is_free=sample.slot_is_free)
            batch.is_local = batch.is_local or sample.arrays is None or bool(sample.header.arena)
            batch.headers[place.row] = sample.header

    while not window.finished:
        began = clock()
        ask()
        # First take what arrived while the trainer was busy. Asking for more before it is busy again keeps the server
        # working.
        while (sample := connection.receive(wait=False)) is not None:
            accept(sample)
            ask()
        while (number := window.take()) is None:
            if (sample := connection.receive()) is not None:
                accept(sample)
                ask()
        ask()
        sample = None  # a reference kept here would keep the batch's buffers and messages alive
        batch = partial.pop(number)
        # Workers on other hosts cannot use slots, and a message without slots is cheaper.
        lend = lend and (batch.is_local or not batch.memory.has_slots)
        headers = [batch.headers[row] for row in range(plan.batch_size)]
        provenance = tuple(conversation.provenance(header) for header in headers)
        quarantine = max([quarantine, *(item.quarantine for item in provenance)])
        tensors = {name: torch.from_numpy(array) for name, array in batch.memory.finish().items()}
        yield Batch(
            arrays=tensors,
            indices=plan.indices(number),
            epoch=epoch,
            provenance=provenance,
            resume_state=resume_state(number, quarantine).to_dict(),
            wait_seconds=clock() - began,
            cpu_seconds=sum(header.cpu_seconds for header in headers),
            decodes=sum(header.decoded for header in headers),
            recipe=recipe,
        )
        del batch, tensors
