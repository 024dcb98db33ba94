"""The logbook: a record of the lease that a local worker works on, which outlives the worker.

A worker that crashes loses its unsent messages. The server may then not know that it finished one sample and began the
next, and would blame the wrong one. So the worker also writes the number of the lease in work into an unnamed file that
it shares with the pool. The kernel keeps this file however the worker ends.
"""

from __future__ import annotations

import os
import tempfile

_BYTES = 8
_DECODES, _SIMULATES = b"d", b"s"
IDLE = 0


class Logbook:
    """The pool's side: created before a worker starts, read after it ends."""

    def __init__(self) -> None:
        # In memory where the system can: a server needs no writable folder for this.
        in_memory = hasattr(os, "memfd_create")
        self._file = os.fdopen(os.memfd_create("v2v-logbook"), "rb") if in_memory else tempfile.TemporaryFile()  # noqa: SIM115

    @property
    def descriptor(self) -> int:
        """File descriptor to pass to the worker process."""
        return self._file.fileno()

    def lease(self) -> int | None:
        """Return the lease in work, or IDLE; None if the worker never wrote anything."""
        entry = os.pread(self.descriptor, _BYTES, 0)
        return int.from_bytes(entry, "little") if len(entry) == _BYTES else None

    def decodes(self) -> bool:
        """Return whether the worker was decoding a video."""
        return os.pread(self.descriptor, 1, _BYTES) == _DECODES

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def note(descriptor: int | None, lease: int, *, decodes: bool = False) -> None:
    """Record the lease in work, or IDLE, and whether its video is being decoded. The worker's side."""
    if descriptor is not None:
        os.pwrite(descriptor, lease.to_bytes(_BYTES, "little") + (_DECODES if decodes else _SIMULATES), 0)
