"""Worker processes that are started before there is work: they import their modules while the server imports its own
and opens its catalogue. The pool then tells them their arguments, in place of starting other processes.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress

from v2v_server.config import ServeConfig
from v2v_server.supervise.child import start_program
from v2v_server.worker.logbook import Logbook


class Standby:
    """One process. It ends if it is not told its arguments before this process ends.

    Raises:
        OSError: it cannot be started.
    """

    def __init__(self) -> None:
        self.logbook = Logbook()
        flags = ["--standby", str(os.getpid())]
        self.process = start_program(
            flags, [self.logbook.descriptor, self.logbook.arenas.fileno()], stdin=subprocess.PIPE
        )

    def begin(self, arguments: Sequence[str]) -> None:
        """Tell it the arguments of ``v2v-worker``.

        Raises:
            OSError: it has ended.
        """
        assert self.process.stdin is not None
        try:
            with self.process.stdin as file:
                file.write("\0".join(arguments).encode())
        except OSError:
            self.close()
            raise

    def close(self) -> None:
        """End it."""
        self.process.kill()
        self.process.communicate()
        self.logbook.close()


@contextmanager
def start_ahead(config: ServeConfig) -> Iterator[list[Standby]]:
    """Start the workers of this host that a server begins with; at the end, end those that are left in the list."""
    standbys: list[Standby] = []
    try:
        with suppress(OSError):  # the pool starts the others, and reports why if it cannot
            while config.engine == "local" and len(standbys) < config.least_workers:
                standbys.append(Standby())
        yield standbys
    finally:
        for standby in standbys:
            standby.close()
