"""Memory that a consumer shares with the server's workers on its host; the rules are in :mod:`v2v_protocol.arena`.

It is an anonymous file that is only ever read and written by calls, never mapped: nothing of it counts as a process's
own memory, a peer cannot make a page fault fail, and it is gone with the last process that has it open.
"""

from __future__ import annotations

import ctypes
import os
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_protocol.arena import ArenaName, slot_bytes
from v2v_protocol.errors import ProtocolError
from v2v_protocol.sample import layout_bytes

_KEEP_SIZE, _PUNCH_HOLE = 1, 2  # FALLOC_FL_*, linux/falloc.h
_MOST_ABANDONED = 256


class Arena:
    """The bytes of slots for samples of one layout. Which of them are in use is :mod:`v2v_client.slots`.

    Memory: slots in use at the same time x bytes of a sample, and what late writers leave in abandoned slots.

    Args:
        layout: dtype and shape of each array, in the order of the headers.

    Raises:
        OSError: the system has no such memory.
    """

    def __init__(self, layout: Mapping[str, tuple[str, tuple[int, ...]]]) -> None:
        token = os.urandom(16).hex()
        name = ArenaName(os.getpid(), -1, token)
        self._descriptor = _anonymous_file(name.memory_name)
        self.name = str(ArenaName(name.pid, self._descriptor, token))
        self._slot_bytes = slot_bytes(layout_bytes({array: form}) for array, form in layout.items())
        # The newest only: an older one could have been written to by a worker that slept that long.
        self._abandoned: deque[int] = deque(maxlen=_MOST_ABANDONED)

    def free(self, slot: int) -> None:
        """Gives the memory of an abandoned slot back to the system, and that of earlier ones, written to since."""
        self._abandoned.append(slot)
        for each in self._abandoned:
            _punch(self._descriptor, each * self._slot_bytes, self._slot_bytes)

    def read(self, slot: int, rows: Mapping[str, npt.NDArray[Any]]) -> None:
        """Copies a sample.

        Args:
            slot: where it is.
            rows: C-contiguous arrays of the layout, to be filled.

        Raises:
            ProtocolError: there is less than a sample.
        """
        offset = slot * self._slot_bytes
        for name, row in rows.items():
            rest = row.reshape(-1).view(np.uint8).data
            while rest:
                count = os.preadv(self._descriptor, [rest], offset)
                if not count:
                    raise ProtocolError(f"slot {slot} ends {len(rest)} bytes before array {name!r} is complete")
                offset, rest = offset + count, rest[count:]

    def close(self) -> None:
        """Frees the memory, as far as no worker is just writing."""
        os.close(self._descriptor)


def open_arena(layout: Mapping[str, tuple[str, tuple[int, ...]]]) -> Arena | None:
    """An arena; None where the system has none, and samples come in messages."""
    try:
        return Arena(layout)
    except OSError:
        return None


def _anonymous_file(name: str) -> int:
    create = getattr(os, "memfd_create", None)  # Linux only
    if create is None:
        raise OSError("this system has no memfd_create")
    descriptor: int = create(name)
    return descriptor


def _punch(descriptor: int, offset: int, length: int) -> None:
    """Frees part of a file. Nothing depends on it but memory, so a system that cannot is left alone."""
    fallocate = getattr(ctypes.CDLL(None), "fallocate", None)
    if fallocate is not None:
        fallocate(descriptor, _PUNCH_HOLE | _KEEP_SIZE, ctypes.c_int64(offset), ctypes.c_int64(length))
