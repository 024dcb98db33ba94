"""The worker's end of a slot: a finished sample goes into its consumer's memory, or where that fails, into the message.

The arena is opened anew for each sample, which takes some microseconds: nothing is kept that would hold the memory of a
consumer that is gone, or have to be tidied up after a worker that is killed.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import closing
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.arena import NO_SLOT, ArenaName, slot_bytes
from v2v_protocol.errors import ProtocolError
from v2v_protocol.messages import Lease
from v2v_protocol.wire import Frames, encode_sample


def sample_message(
    lease: Lease,
    arrays: Mapping[str, npt.NDArray[Any]],
    *,
    provenance: Mapping[str, Any],
    worker: str,
    cpu_seconds: float,
    decoded: bool = True,
) -> Frames:
    """The frames of a lease's sample; its arrays are in the slot that the lease names, where that can be reached.

    Args:
        lease: what was asked.
        arrays: of the sample, C-contiguous.
        provenance, worker, cpu_seconds, decoded: see :class:`v2v_protocol.messages.SampleHeader`.
    """
    return encode_sample(
        epoch=lease.epoch,
        index=lease.indices[0],
        arrays=arrays,
        provenance=provenance,
        worker=worker,
        cpu_seconds=cpu_seconds,
        decoded=decoded,
        slot=lease.slot,
        in_slot=lease.slot != NO_SLOT and put(lease.arena, lease.slot, arrays),
    )


def put(arena: str, slot: int, arrays: Mapping[str, npt.NDArray[Any]]) -> bool:
    """Writes the arrays into a slot, one after the other.

    Returns:
        False where that was not possible: the arena is not on this host, not this user's, gone, or memory ran out.
    """
    try:
        name = ArenaName.parse(arena)
        with closing(_Arena(name)) as opened:
            opened.write(slot * slot_bytes(array.nbytes for array in arrays.values()), arrays)
    except (OSError, ProtocolError):
        return False
    return True


class _Arena:
    """An open arena.

    Raises:
        OSError: it is not there.
    """

    def __init__(self, name: ArenaName) -> None:
        # The link is read first: opening something else, a device or a pipe, may have effects of its own.
        if os.readlink(name.path) != name.link:
            raise FileNotFoundError(name.path)
        self._descriptor = os.open(name.path, os.O_WRONLY | os.O_CLOEXEC | os.O_NONBLOCK)
        if os.readlink(f"/proc/self/fd/{self._descriptor}") != name.link:
            self.close()
            raise FileNotFoundError(name.path)

    def write(self, offset: int, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
        for array in arrays.values():
            rest = array.reshape(-1).view(np.uint8).data
            while rest:
                written = os.pwrite(self._descriptor, rest, offset)
                offset, rest = offset + written, rest[written:]

    def close(self) -> None:
        os.close(self._descriptor)
