"""The worker's end of a slot: a sample is made in its consumer's memory, or where that cannot be reached, in its own.

The arena is opened and mapped anew for each sample, which takes less than a millisecond: nothing is kept that would
hold the memory of a consumer that is gone, or have to be tidied up after a worker that is killed.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import zstandard

from v2v_protocol.arena import NO_SLOT, ArenaName, Slot, array_offsets
from v2v_protocol.errors import ProtocolError
from v2v_protocol.messages import Lease
from v2v_protocol.sample import Form, Layout, new_arrays
from v2v_protocol.wire import Buffer, Frames, encode_sample


@dataclass(frozen=True, slots=True)
class Room:
    """Where a sample is made.

    Attributes:
        arrays: C-contiguous, of its layout, of unspecified content. Memory of another process is let go with them.
        in_slot: whether they are the slot that the lease names.
    """

    arrays: Mapping[str, npt.NDArray[Any]]
    in_slot: bool


def room_for(lease: Lease, layout: Layout) -> Room:
    """The lease's slot, where it names one that can be reached; fresh memory otherwise.

    Args:
        lease: what was asked.
        layout: of its sample.
    """
    if lease.slot != NO_SLOT:
        there = slot_arrays(Slot(lease.arena, lease.slot), layout)
        if there is not None:
            return Room(there, in_slot=True)
    return Room(new_arrays(layout), in_slot=False)


def sample_message(
    lease: Lease,
    room: Room,
    *,
    provenance: Mapping[str, Any],
    worker: str,
    cpu_seconds: float,
    decoded: bool = True,
    cache: str = "",
    packed: bool = False,
) -> Frames:
    """The frames of a lease's sample. Who sends them writes to the room no more.

    Args:
        lease: what was asked.
        room: where its sample was made.
        provenance, worker, cpu_seconds, decoded, cache: see :class:`v2v_protocol.messages.SampleHeader`.
        packed: arrays that do not lie in a slot are compressed, whatever the lease says of it.
    """
    return encode_sample(
        epoch=lease.epoch,
        index=lease.indices[0],
        arrays=room.arrays,
        provenance=provenance,
        worker=worker,
        cpu_seconds=cpu_seconds,
        decoded=decoded,
        cache=cache,
        slot=lease.slot,
        in_slot=room.in_slot,
        quarantine=lease.quarantine,
        pack=pack if packed or lease.packed else None,
    )


def pack(raw: Buffer) -> bytes:
    """An array's bytes as one zstd frame that states their number."""
    # Level 1: a twelfth of the bytes is left, and higher levels take longer for little more (v2v-tradeoff).
    return zstandard.ZstdCompressor(level=1, write_checksum=False).compress(raw)


def slot_arrays(slot: Slot, layout: Layout) -> dict[str, npt.NDArray[Any]] | None:
    """The slot's arrays, mapped.

    Returns:
        None where that is not possible: the arena is not on this host, not this user's, gone, of another size, or could
        be cut short by its owner while we write.
    """
    try:
        name = ArenaName.parse(slot.arena)
        if not 0 < slot.number <= name.slots:
            return None
        places, total = _places(tuple(layout.items()), name.slots)
        with closing(_OpenArena(name, total)) as arena:
            return {
                array: arena.map(offset + (slot.number - 1) * size, size).view(dtype).reshape(shape)
                for array, dtype, shape, size, offset in places
            }
    except (OSError, ProtocolError):
        return None


_Place: TypeAlias = tuple[str, np.dtype[Any], tuple[int, ...], int, int]


@lru_cache(maxsize=16)  # the same for every sample of a stream
def _places(layout: tuple[tuple[str, tuple[str, tuple[int, ...]]], ...], slots: int) -> tuple[list[_Place], int]:
    """(name, dtype, shape, bytes of one sample, offset of the first) of each array in an arena; the arena's bytes."""
    sizes = Form.of(dict(layout)).sizes
    *offsets, total = array_offsets(sizes, slots)
    places = [
        (array, np.dtype(dtype), shape, size, offset)
        for (array, (dtype, shape)), size, offset in zip(layout, sizes, offsets, strict=True)
    ]
    return places, total


class _OpenArena:
    """An open arena.

    Raises:
        OSError: it is not there, not of that many bytes, or its size is not sealed.
    """

    def __init__(self, name: ArenaName, size: int) -> None:
        # The link is read first: opening something else, a device or a pipe, may have effects of its own.
        if os.readlink(name.path) != name.link:
            raise FileNotFoundError(name.path)
        self._descriptor = os.open(name.path, os.O_RDWR | os.O_CLOEXEC | os.O_NONBLOCK)
        try:
            if os.readlink(f"/proc/self/fd/{self._descriptor}") != name.link:
                raise FileNotFoundError(name.path)
            _require_sealed(self._descriptor, size)
        except BaseException:
            self.close()
            raise

    def map(self, offset: int, size: int) -> npt.NDArray[np.uint8]:
        """Bytes of the arena; unmapped when nothing refers to them any more."""
        begin = offset // mmap.ALLOCATIONGRANULARITY * mmap.ALLOCATIONGRANULARITY
        # All pages at once: taken one by one as they are written, they cost more than copying the sample.
        flags = mmap.MAP_SHARED | mmap.MAP_POPULATE
        mapping = mmap.mmap(self._descriptor, offset - begin + size, flags, offset=begin)
        return np.frombuffer(mapping, np.uint8, size, offset - begin)

    def close(self) -> None:
        os.close(self._descriptor)


def _require_sealed(descriptor: int, size: int) -> None:
    """A page beyond the end of a file cannot be written to: that would be the end of this process."""
    from fcntl import F_GET_SEALS, F_SEAL_SHRINK, fcntl  # of Linux, like arenas

    if not fcntl(descriptor, F_GET_SEALS) & F_SEAL_SHRINK:
        raise OSError("its size is not sealed")
    if os.fstat(descriptor).st_size != size:
        raise OSError(f"it is not of {size} bytes")
