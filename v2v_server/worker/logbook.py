"""What a worker shares with its pool: a record of the lease in work, and a socket pair for the arenas of its leases.

A worker that crashes loses its unsent messages. The server may then not know that it finished one sample and began the
next, and would blame the wrong one. So the worker also writes the number of the lease in work into an unnamed file that
it shares with the pool. The kernel keeps this file however the worker ends.

A confined worker cannot open the memory of other processes. So the pool opens the arena of each lease, sends the
descriptor before the lease, and closes its own. The worker takes it when it makes the sample. Neither keeps an arena
open in between, so the memory of a consumer that is gone is freed.
"""

from __future__ import annotations

import os
import tempfile
from contextlib import suppress
from socket import recv_fds, send_fds, socket, socketpair

from v2v_protocol.arena import ArenaName, find_memory

_BYTES = 8
_DECODES, _SIMULATES = b"d", b"s"
IDLE = 0


class Logbook:
    """The pool's side: created before a worker starts, read after it ends.

    Attributes:
        arenas: the worker's end of the socket pair.
    """

    def __init__(self) -> None:
        # In memory where the system can: a server needs no writable folder for this.
        in_memory = hasattr(os, "memfd_create")
        self._file = os.fdopen(os.memfd_create("v2v-logbook"), "rb") if in_memory else tempfile.TemporaryFile()  # noqa: SIM115
        self._pool, self.arenas = socketpair()
        self._pool.setblocking(False)

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

    def lend(self, arena: str) -> None:
        """Send the worker the token of a lease's arena, with its descriptor if the arena is accessible here.

        Raises:
            ProtocolError: the text does not name an arena.
        """
        name = ArenaName.parse(arena)
        found: list[int] = []
        with suppress(OSError):
            found.append(find_memory(name, writable=True))
        with suppress(OSError):  # the worker has ended, or is stopped
            send_fds(self._pool, [name.token.encode()], found)
        for descriptor in found:
            os.close(descriptor)

    def close(self) -> None:
        """Close the file and the socket pair."""
        for each in (self._file, self._pool, self.arenas):
            each.close()


def note(descriptor: int | None, lease: int, *, decodes: bool = False) -> None:
    """Record the lease in work, or IDLE, and whether its video is being decoded. The worker's side."""
    if descriptor is not None:
        os.pwrite(descriptor, lease.to_bytes(_BYTES, "little") + (_DECODES if decodes else _SIMULATES), 0)


def take_arena(arenas: socket, name: ArenaName, writable: bool) -> int:
    """Return the descriptor of a lease's arena; close those of leases that were not worked on. The worker's side.

    Raises:
        OSError: the arena is not accessible to the pool, or nothing came in the socket's time.
    """
    while True:
        token, found, *_ = recv_fds(arenas, len(name.token), 1)
        is_it = token.decode() in (name.token, "")  # nothing is left of a pool that has ended
        if is_it and found:
            return found[0]
        if is_it:
            raise FileNotFoundError(name.path)
        for descriptor in found:
            os.close(descriptor)
