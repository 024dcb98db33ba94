"""Workers as processes of this host. The process that starts them also reaps them.

Workers are started as programs of their own (never forked), in their own process group so that Ctrl-C in a terminal
reaches only the server, and die with the server even when it is killed.
"""

from __future__ import annotations

import errno
import math
import os
import subprocess
import time
from collections.abc import Sequence

from v2v_protocol.keys import PeerKey
from v2v_server.broker.leases import Cause, Loss
from v2v_server.config import ServeConfig
from v2v_server.supervise.child import (
    Standby,
    arguments,
    out_of_memory_kills,
    post_mortem,
    queued_seconds,
    start_child,
    status_of,
)
from v2v_server.supervise.host import Exit, ProcessStatus
from v2v_server.worker.logbook import Logbook

_MEMORY_SECONDS = 5.0
"""Time after the kernel has killed a process for lack of memory in which a worker's SIGKILL is attributed to that."""
_SHORTAGES = (errno.EAGAIN, errno.ENOMEM, errno.EMFILE, errno.ENFILE)
_AFTER_SHORTAGE_SECONDS = 5.0


def make_host(
    config: ServeConfig, root: str, label: str, flags: Sequence[str], key: PeerKey | None, standbys: list[Standby]
) -> LocalHost:
    """Return the host that the configuration asks for."""
    return LocalHost(root, flags, standbys)


class LocalHost:
    """This host.

    Args:
        root: the corpus, a folder or an address.
        flags: further flags of each worker.
        standbys: processes to use first.
    """

    is_local = True
    status_seconds = 1.0

    def __init__(
        self, root: str | os.PathLike[str], flags: Sequence[str] = (), standbys: list[Standby] | None = None
    ) -> None:
        self.root = os.fspath(root)
        self.flags = flags
        self.standbys = [] if standbys is None else standbys
        self._now = 0.0
        self._memory_kills = out_of_memory_kills()
        self._short_of_memory_until = -math.inf

    def place(self, number: int) -> LocalPlace:
        """Return a place for the worker of a slot."""
        return LocalPlace(self)

    def request(self, workers: int) -> None:
        """Do nothing: this host has no reservations."""

    def refresh(self, now: float) -> None:
        """Note the time and whether the host is short of memory."""
        self._now = now
        self.is_short_of_memory()

    def is_short_of_memory(self) -> bool:
        """Return whether the kernel has killed a process for lack of memory a moment ago."""
        kills = out_of_memory_kills()
        if kills > self._memory_kills:
            self._memory_kills, self._short_of_memory_until = kills, self._now + _MEMORY_SECONDS
        return self._now < self._short_of_memory_until

    def wait(self, places: Sequence[LocalPlace], seconds: float) -> list[LocalPlace]:
        """Wait until the workers have ended; return the places of those that have not."""
        deadline = time.monotonic() + seconds
        return [place for place in places if not place.wait(max(0.0, deadline - time.monotonic()))]

    def news(self) -> list[str]:
        """Return no lines: all workers are on this host."""
        return []

    def close(self) -> None:
        """Do nothing: the places hold all there is."""


class LocalPlace:
    """One process at a time.

    Args:
        host: the host with what its workers need.
    """

    def __init__(self, host: LocalHost) -> None:
        self._host = host
        self._failure: Exit | None = None
        self.process: subprocess.Popen[bytes] | None = None
        self.logbook: Logbook | None = None

    @property
    def is_running(self) -> bool:
        """Return whether its process runs."""
        return self.process is not None and self.process.poll() is None

    def start(self, name: str, address: str) -> None:
        """Start a worker that connects to ``address``.

        A host that has no more processes, files or memory for it does not end the workers that run, and does not count
        towards the crash budget.
        """
        try:
            if self._host.standbys:
                standby = self._host.standbys.pop()
                standby.begin(arguments(address, self._host.root, name, self._host.flags, standby.logbook))
                self.logbook, self.process = standby.logbook, standby.process
            else:
                self.logbook = Logbook()
                self.process = start_child(address, self._host.root, name, self._host.flags, self.logbook)
        except OSError as error:
            self._forget()
            loss = Loss(Cause.KILLED, f"could not be started: {error.strerror or error}")
            is_shortage = error.errno in _SHORTAGES
            self._failure = Exit(loss, retry_seconds=_AFTER_SHORTAGE_SECONDS if is_shortage else None)

    def take_exit(self) -> Exit | None:
        """Return once how the worker ended; None while it has not ended."""
        if self._failure is not None:
            failure, self._failure = self._failure, None
            return failure
        returncode = None if self.process is None else self.process.poll()
        if returncode is None:
            return None
        # The kernel counts a kill before its victim is gone, so it is included.
        loss = post_mortem(returncode, self.logbook, short_of_memory=self._host.is_short_of_memory())
        self._forget()
        return Exit(loss, returncode)

    def status(self, now: float) -> ProcessStatus | None:
        """Observe the worker's process; None without one."""
        if self.process is None or self.logbook is None:
            return None
        pid = self.process.pid
        return ProcessStatus(status_of(pid), queued_seconds(pid), self.logbook.lease(), self.logbook.decodes(), now)

    def lend(self, arena: str) -> None:
        """Pass the worker the arena of its next lease."""
        if self.logbook is not None:
            self.logbook.lend(arena)

    def leave(self) -> bool:
        """Tell the worker to finish its sample and exit; return False if there is none to tell."""
        if self.process is not None:
            self.process.terminate()
        return self.process is not None

    def signal(self, number: int) -> None:
        """Send the worker's process a signal, if it runs."""
        if self.process is not None:
            self.process.send_signal(number)

    def wait(self, seconds: float) -> bool:
        """Wait for the end of the worker's process; return whether it has ended."""
        try:
            return self.process is None or self.process.wait(seconds) is not None
        except subprocess.TimeoutExpired:
            return False

    def release(self) -> None:
        """Kill and reap the worker's process, if there is one."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()
        self._forget()

    def _forget(self) -> None:
        self.process = None
        if self.logbook is not None:
            self.logbook.close()
            self.logbook = None
