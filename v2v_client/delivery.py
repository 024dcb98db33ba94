"""Assemble samples into batches. Rows are filled in any order; batches leave in order."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import torch

from v2v_client.batch import Batch
from v2v_client.memory.buffers import BatchBuffers, BatchMemory
from v2v_client.ordering import ReorderWindow
from v2v_client.position.plan import EpochPlan
from v2v_client.position.state import ResumeState
from v2v_client.session.connection import Connection
from v2v_client.session.conversation import Arrival
from v2v_protocol.messages import SampleHeader


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
    window = ReorderWindow(batches, plan.indices, plan.batch_size, connection.credit)
    most_partial = -(-connection.credit // plan.batch_size) + 2
    # One more for the batch that the trainer holds: all of them are free when an epoch ends.
    buffers.shape(connection.layout, plan.batch_size, spare=most_partial + 1)
    partial: dict[int, _PartialBatch] = {}
    quarantine, lend = 0, shared_memory

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
        provenance = tuple(connection.provenance(header) for header in headers)
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
        )
        del batch, tensors
