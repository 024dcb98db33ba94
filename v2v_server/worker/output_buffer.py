"""Provide memory for a sample: its consumer's slot, or private memory if the slot is not accessible.

The arena is opened and mapped for each sample, which takes less than a millisecond. So no mapping keeps the memory of a
consumer that is gone, and a killed worker leaves nothing to clean up. A confined worker cannot open it, and receives
its descriptor from the server (:func:`v2v_server.worker.logbook.take_arena`).

An arena with one slot, such as the server's (:mod:`v2v_server.sharing.ring`), is new memory as a rule. Writing a
finished sample to it takes less than half the time of mapping it, because its pages need no zeros and no faults.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import zstandard

from v2v_protocol.arena import NO_SLOT, ArenaName, Slot, array_offsets, find_memory, open_memory
from v2v_protocol.errors import ProtocolError
from v2v_protocol.messages import Buffer, Frames, Lease, encode_sample
from v2v_protocol.sample import Form, Layout, new_arrays

Find: TypeAlias = Callable[[ArenaName, bool], int]


@dataclass(frozen=True, slots=True)
class OutputBuffer:
    """Memory for a sample.

    Attributes:
        arrays: C-contiguous, of the sample's layout, with unspecified content. Shared memory is unmapped when they are
            freed.
        in_slot: whether they are the slot that the lease names.
        find: how the lease's arena is found.
    """

    arrays: Mapping[str, npt.NDArray[Any]]
    in_slot: bool
    find: Find = find_memory


def open_output_buffer(lease: Lease, layout: Layout, find: Find = find_memory) -> OutputBuffer:
    """Return the lease's slot if it names an accessible one, otherwise new memory.

    Args:
        lease: the work.
        layout: layout of its sample.
        find: how its arena is found, see :func:`v2v_protocol.arena.open_memory`.
    """
    if lease.slot != NO_SLOT and not _has_one_slot(lease.arena):
        there = slot_arrays(Slot(lease.arena, lease.slot), layout, find)
        if there is not None:
            return OutputBuffer(there, in_slot=True)
    return OutputBuffer(new_arrays(layout), in_slot=False, find=find)


def sample_message(
    lease: Lease,
    buffer: OutputBuffer,
    *,
    provenance: Mapping[str, Any],
    worker: str,
    cpu_seconds: float,
    decoded: bool = True,
    cache: str = "",
    packed: bool = False,
) -> Frames:
    """Build the frames of a lease's sample. The buffer must not be changed afterwards.

    Args:
        lease: the work.
        buffer: where its sample was made.
        provenance, worker, cpu_seconds, decoded, cache: see :class:`v2v_protocol.messages.SampleHeader`.
        packed: compress arrays outside a slot even if the lease does not ask for it.
    """
    in_slot = buffer.in_slot or (_has_one_slot(lease.arena) and _write(lease, buffer))
    return encode_sample(
        epoch=lease.epoch,
        index=lease.indices[0],
        arrays=buffer.arrays,
        provenance=provenance,
        worker=worker,
        cpu_seconds=cpu_seconds,
        decoded=decoded,
        cache=cache,
        slot=lease.slot,
        in_slot=in_slot,
        quarantine=lease.quarantine,
        pack=pack if packed or lease.packed else None,
    )


def pack(raw: Buffer) -> bytes:
    """Compress an array's bytes to one zstd frame that states their number."""
    # Level 1 leaves a twelfth of the bytes; higher levels take longer and save little more (v2v-tradeoff).
    return zstandard.ZstdCompressor(level=1, write_checksum=False).compress(raw)


def slot_arrays(slot: Slot, layout: Layout, find: Find = find_memory) -> dict[str, npt.NDArray[Any]] | None:
    """Map the arrays of a slot. ``find`` finds its arena.

    Returns:
        None if that is not possible: the arena is not on this host, belongs to another user, is gone, has another size,
        or could be truncated by its owner during a write.
    """
    try:
        name = ArenaName.parse(slot.arena)
        if not 0 < slot.number <= name.slots:
            return None
        places, total = _places(tuple(layout.items()), name.slots)
        descriptor = open_memory(name, total, writable=True, find=find)
        try:
            return {
                array: _map(descriptor, offset + (slot.number - 1) * size, size).view(dtype).reshape(shape)
                for array, dtype, shape, size, offset in places
            }
        finally:
            os.close(descriptor)
    except (OSError, ProtocolError):
        return None


def _has_one_slot(arena: str) -> bool:
    try:
        return bool(arena) and ArenaName.parse(arena).slots == 1
    except ProtocolError:
        return False


def _write(lease: Lease, buffer: OutputBuffer) -> bool:
    """Write a sample to the lease's arena of one slot; return False if it is not accessible or memory is full."""
    raw = [array.reshape(-1).view(np.uint8).data for array in buffer.arrays.values()]
    *offsets, total = array_offsets([len(each) for each in raw], 1)
    try:
        descriptor = open_memory(ArenaName.parse(lease.arena), total, writable=True, find=buffer.find)
        try:
            for offset, rest in zip(offsets, raw, strict=True):
                while rest:
                    written = os.pwrite(descriptor, rest, offset)
                    offset, rest = offset + written, rest[written:]
        finally:
            os.close(descriptor)
    except OSError:
        return False
    return True


_Place: TypeAlias = tuple[str, np.dtype[Any], tuple[int, ...], int, int]


@lru_cache(maxsize=16)  # the same for every sample of a stream
def _places(layout: tuple[tuple[str, tuple[str, tuple[int, ...]]], ...], slots: int) -> tuple[list[_Place], int]:
    """Return (name, dtype, shape, bytes of one sample, offset of the first) of each array in an arena, and the
    arena's bytes.
    """
    sizes = Form.of(dict(layout)).sizes
    *offsets, total = array_offsets(sizes, slots)
    places = [
        (array, np.dtype(dtype), shape, size, offset)
        for (array, (dtype, shape)), size, offset in zip(layout, sizes, offsets, strict=True)
    ]
    return places, total


def _map(descriptor: int, offset: int, size: int) -> npt.NDArray[np.uint8]:
    """Map bytes of an arena; they are unmapped when nothing refers to them any more."""
    begin = offset // mmap.ALLOCATIONGRANULARITY * mmap.ALLOCATIONGRANULARITY
    # Map all pages at once: faulting them in one by one costs more than copying the sample.
    flags = mmap.MAP_SHARED | mmap.MAP_POPULATE
    mapping = mmap.mmap(descriptor, offset - begin + size, flags, offset=begin)
    return np.frombuffer(mapping, np.uint8, size, offset - begin)
