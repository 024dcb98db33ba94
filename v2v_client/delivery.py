"""From arrivals to batches: rows are filled in any order, batches leave in theirs."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy.typing as npt
import torch

from v2v_client.batch import Batch
from v2v_client.memory.buffers import BatchBuffers, Memory, SharedMemory
from v2v_client.ordering import ReorderWindow
from v2v_client.position.world import EpochPlan
from v2v_client.session.arrival import Arrival
from v2v_client.session.connection import Connection
from v2v_protocol.arena import Slot
from v2v_protocol.errors import ProtocolError
from v2v_protocol.messages import SampleHeader
from v2v_protocol.sample import Provenance


class _Draft:
    """A batch being filled.

    Workers may put samples into the slots of its memory. Where a sample came otherwise, and a worker may still write to
    its slot, the batch moves to memory of its own.
    """

    def __init__(self, buffers: BatchBuffers, samples: int, *, shared: bool) -> None:
        self._buffers = buffers
        self._memory: Memory = (buffers.shared() if shared else None) or buffers.own()
        self.lent = isinstance(self._memory, SharedMemory)
        self._left: SharedMemory | None = None
        self.headers: list[SampleHeader | None] = [None] * samples
        self.cpu_seconds = 0.0
        self.decodes = 0
        self.in_place = 0  # samples that a worker put into their row

    def slot(self, row: int) -> Slot | None:
        """For the sample of a row, when it is asked for."""
        return self._memory.slot(row)

    def fill(self, row: int, sample: Arrival) -> None:
        payload = sample.payload
        if not payload.row_is_ours:
            self._leave()
        if payload.arrays is not None:
            self._memory.put(row, payload.arrays)
        else:
            self.in_place += 1
            if self._left is not None:
                self._memory.put(row, self._left.get(row))
        self.headers[row] = sample.header
        self.cpu_seconds += sample.header.cpu_seconds
        self.decodes += sample.header.decoded

    def _leave(self) -> None:
        left = self._memory
        if isinstance(left, SharedMemory):
            self._left, self._memory = left, self._buffers.own()
            for row, there in enumerate(self.headers):
                if there is not None:
                    self._memory.put(row, left.get(row))

    def whole(self) -> dict[str, npt.NDArray[Any]]:
        """All of it; to be called once."""
        return self._memory.whole()


def deliver(
    connection: Connection,
    plan: EpochPlan,
    batches: Sequence[int],
    epoch: int,
    resume_state: Callable[[int, int], Mapping[str, Any]],
    buffers: BatchBuffers,
    *,
    shared_memory: bool = True,
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[Batch]:
    """The batches of an open connection, in order.

    Args:
        plan: which samples make up a batch.
        batches: numbers of the batches to deliver.
        epoch: of the samples.
        resume_state: the state after a batch, by its number and the newest quarantine snapshot seen up to it.
        buffers: for the batches.
        shared_memory: whether workers of this host may put samples into memory of this process.
        clock: seconds, for ``Batch.wait_seconds``.

    Raises:
        see :meth:`Connection.receive`.
    """
    window = ReorderWindow(batches, plan.indices, plan.batch_size, connection.credit)
    most_drafts = -(-connection.credit // plan.batch_size) + 2
    # And the one that the trainer has: all of them are free when an epoch ends.
    buffers.shape(connection.layout, plan.batch_size, spare=most_drafts + 1)
    drafts: dict[int, _Draft] = {}
    quarantine, lend = 0, shared_memory

    def ask() -> None:
        asked, slots = window.ask(), {}
        for index in asked:
            place = window.place(index)
            if place.batch not in drafts:
                drafts[place.batch] = _Draft(buffers, plan.batch_size, shared=lend)
            slot = drafts[place.batch].slot(place.row)
            if slot is not None:
                slots[index] = slot
        connection.want(asked, slots)

    def accept(sample: Arrival) -> None:
        place = window.receive(sample.header.index)
        if place is not None:
            drafts[place.batch].fill(place.row, sample)

    while not window.finished:
        began = clock()
        ask()
        # What came while the trainer was busy; asking for more before it is busy again keeps the server at work.
        while (sample := connection.receive(wait=False)) is not None:
            accept(sample)
            ask()
        while (number := window.take()) is None:
            if (sample := connection.receive()) is not None:
                accept(sample)
                ask()
        ask()
        sample = None  # nothing of this batch may outlive it here, or its buffers and messages would not be freed
        draft = drafts.pop(number)
        # Workers elsewhere have no use for it, and a message is cheaper without.
        lend = lend and (draft.in_place > 0 or not draft.lent)
        provenance = tuple(connection.provenance(header) for header in draft.headers if header is not None)
        quarantine = max([quarantine, *(item.quarantine for item in provenance)])
        yield _finished(
            draft, plan.indices(number), provenance, epoch, resume_state(number, quarantine), clock() - began
        )


def _finished(
    draft: _Draft,
    indices: tuple[int, ...],
    provenance: tuple[Provenance, ...],
    epoch: int,
    resume_state: Mapping[str, Any],
    wait_seconds: float,
) -> Batch:
    if len(provenance) != len(indices):
        raise ProtocolError(f"a batch of {len(indices)} samples has {len(provenance)}: the reorder window is at fault")
    tensors = {name: torch.from_numpy(array) for name, array in draft.whole().items()}
    return Batch(
        voxels=tensors.get("voxels"),
        frames=tensors.get("frames"),
        flow=tensors.get("flow"),
        flow_valid=tensors.get("flow_valid"),
        indices=indices,
        epoch=epoch,
        provenance=provenance,
        resume_state=resume_state,
        wait_seconds=wait_seconds,
        cpu_seconds=draft.cpu_seconds,
        decodes=draft.decodes,
    )
