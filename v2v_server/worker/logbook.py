"""The logbook: which lease a local worker is at, in its own hand, where it outlives the worker.

A worker that crashes takes its unsent messages with it: that it had finished one sample and begun the next may never
reach the server, which would then blame the wrong one. So the worker also writes the number of the lease it is at into
a nameless file that it shares with the pool; the kernel keeps that, whatever ends the worker.
"""

from __future__ import annotations

import os
import tempfile

_BYTES = 8
_DECODES, _SIMULATES = b"d", b"s"
IDLE = 0


class Logbook:
    """The pool's side: made before a worker is started, read when it is gone."""

    def __init__(self) -> None:
        # In memory where the system can: a server needs no writable folder for this.
        in_memory = hasattr(os, "memfd_create")
        self._file = os.fdopen(os.memfd_create("v2v-logbook"), "rb") if in_memory else tempfile.TemporaryFile()  # noqa: SIM115

    @property
    def descriptor(self) -> int:
        """To be passed on to the worker process."""
        return self._file.fileno()

    def lease(self) -> int | None:
        """The lease the worker was at, IDLE for none; None when it never wrote anything."""
        entry = os.pread(self.descriptor, _BYTES, 0)
        return int.from_bytes(entry, "little") if len(entry) == _BYTES else None

    def decodes(self) -> bool:
        """Whether the worker was decoding a video."""
        return os.pread(self.descriptor, 1, _BYTES) == _DECODES

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()


def note(descriptor: int | None, lease: int, *, decodes: bool = False) -> None:
    """The worker's side: it is at this lease now, or IDLE; and whether at the decoding of its video."""
    if descriptor is not None:
        os.pwrite(descriptor, lease.to_bytes(_BYTES, "little") + (_DECODES if decodes else _SIMULATES), 0)
