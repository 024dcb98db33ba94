"""From arrivals to batches: rows are filled in any order, batches leave in theirs."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy.typing as npt
import torch

from v2v_client.arrival import Arrival
from v2v_client.batch import Batch
from v2v_client.buffers import BatchBuffers
from v2v_client.connection import Connection
from v2v_client.ordering import ReorderWindow
from v2v_client.world import EpochPlan
from v2v_protocol.errors import ProtocolError
from v2v_protocol.sample import Provenance


class _Draft:
    """A batch being filled."""

    def __init__(self, arrays: dict[str, npt.NDArray[Any]], samples: int) -> None:
        self.arrays = arrays
        self.provenance: list[Provenance | None] = [None] * samples
        self.cpu_seconds = 0.0
        self.decodes = 0

    def fill(self, row: int, sample: Arrival) -> None:
        sample.payload.copy_to({name: array[row] for name, array in self.arrays.items()})
        self.provenance[row] = sample.provenance
        self.cpu_seconds += sample.cpu_seconds
        self.decodes += sample.decoded


def deliver(
    connection: Connection,
    plan: EpochPlan,
    batches: Sequence[int],
    epoch: int,
    resume_state: Callable[[int, int], Mapping[str, Any]],
    buffers: BatchBuffers,
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[Batch]:
    """The batches of an open connection, in order.

    Args:
        plan: which samples make up a batch.
        batches: numbers of the batches to deliver.
        epoch: of the samples.
        resume_state: the state after a batch, by its number and the newest quarantine snapshot seen up to it.
        buffers: for the batches.
        clock: seconds, for ``Batch.wait_seconds``.

    Raises:
        see :meth:`Connection.receive`.
    """
    window = ReorderWindow(batches, plan.indices, plan.batch_size, connection.credit)
    most_drafts = -(-connection.credit // plan.batch_size) + 2
    buffers.shape(connection.layout, plan.batch_size, spare=most_drafts)
    drafts: dict[int, _Draft] = {}
    quarantine = 0

    def accept(sample: Arrival) -> None:
        slot = window.receive(sample.index)
        if slot is None:
            sample.payload.drop()
            return
        if slot.batch not in drafts:
            drafts[slot.batch] = _Draft(buffers.take(), plan.batch_size)
        drafts[slot.batch].fill(slot.row, sample)

    while not window.finished:
        began = clock()
        connection.want(window.ask())
        # What came while the trainer was busy; asking for more before it is busy again keeps the server at work.
        while (sample := connection.receive(wait=False)) is not None:
            accept(sample)
            connection.want(window.ask())
        while (number := window.take()) is None:
            if (sample := connection.receive()) is not None:
                accept(sample)
                connection.want(window.ask())
        connection.want(window.ask())
        sample = None  # nothing of this batch may outlive it here, or its buffers and messages would not be freed
        draft = drafts.pop(number)
        quarantine = max([quarantine, *(item.quarantine for item in draft.provenance if item is not None)])
        yield _finished(draft, plan.indices(number), epoch, resume_state(number, quarantine), clock() - began)


def _finished(
    draft: _Draft, indices: tuple[int, ...], epoch: int, resume_state: Mapping[str, Any], wait_seconds: float
) -> Batch:
    provenance = tuple(item for item in draft.provenance if item is not None)
    if len(provenance) != len(indices):
        raise ProtocolError(f"a batch of {len(indices)} samples has {len(provenance)}: the reorder window is at fault")
    tensors = {name: torch.from_numpy(array) for name, array in draft.arrays.items()}
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
