"""Workers as processes of this host. The process that starts them also reaps them.

Workers are started as programs of their own (never forked), in a session of their own: they have no terminal, Ctrl-C
reaches only the server, which prints what they write, and they die with the server even when it is killed. An actor on
another host (:mod:`v2v_server.supervise.ray_host`) starts them, and interprets their ends, in the same way.

Processes may be started before there is work: they import their modules while the server imports its own and opens its
catalogue. The pool then tells them their arguments, in place of starting other processes.
"""

from __future__ import annotations

import errno
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import psutil

from v2v_protocol.errors import undo_on_error
from v2v_protocol.keys import PeerKey, nameless_key
from v2v_protocol.programs import environment
from v2v_server.broker.leases import Cause, Loss
from v2v_server.config import ServeConfig
from v2v_server.supervise.pool import Exit, ProcessStatus
from v2v_server.system.process import out_of_memory_kills, relayed_output
from v2v_server.worker.logbook import Logbook

_CRASH_SIGNALS = (signal.SIGSEGV, signal.SIGBUS, signal.SIGABRT, signal.SIGILL, signal.SIGFPE)
PROGRAM = (sys.executable, "-m", "v2v_server.commands.worker")
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
_MEMORY_SECONDS = 5.0
"""Time after the kernel has killed a process for lack of memory in which a worker's SIGKILL is attributed to that."""
_SHORTAGES = (errno.EAGAIN, errno.ENOMEM, errno.EMFILE, errno.ENFILE)
_AFTER_SHORTAGE_SECONDS = 5.0


class WorkerProcess:
    """The process of one worker on this host, with its logbook. It ends with this process.

    Args:
        address: where the server listens for workers; "": it gets ready, and is told its arguments later.
        root: the corpus, a folder or an address.
        name: unique name of the worker.
        flags: further flags.
        key: its key, passed in an unnamed file: neither command line, environment nor disk shows it.

    Raises:
        OSError: it cannot be started.
    """

    def __init__(
        self, address: str = "", root: str = "", name: str = "", flags: Sequence[str] = (), key: PeerKey | None = None
    ) -> None:
        self.logbook = Logbook()
        handed = [self.logbook.descriptor, self.logbook.arenas.fileno()]
        with ExitStack() as opened, ExitStack() as undo:
            undo.callback(self.logbook.close)
            if key is not None:
                handed.append(opened.enter_context(nameless_key(key)).fileno())
                flags = [*flags, "--keys", f"/dev/fd/{handed[-1]}"]
            told = arguments(address, root, name, flags, self.logbook) if address else ["--standby", str(os.getpid())]
            self.process = subprocess.Popen(
                [*PROGRAM, *told],
                stdin=subprocess.DEVNULL if address else subprocess.PIPE,
                stdout=relayed_output().fileno(),
                stderr=subprocess.STDOUT,
                pass_fds=handed,
                env=environment() | _ONE_THREAD,
                start_new_session=True,
            )
            undo.pop_all()

    def begin(self, told: Sequence[str]) -> None:
        """Tell one that is ready the :func:`arguments` of ``v2v-worker``.

        Raises:
            OSError: it has ended.
        """
        assert self.process.stdin is not None
        with undo_on_error(self.end), self.process.stdin as file:
            file.write("\0".join(told).encode())

    def status(self, now: float = 0.0) -> ProcessStatus:
        """Observe it."""
        pid, logbook = self.process.pid, self.logbook
        return ProcessStatus(status_of(pid), queued_seconds(pid), logbook.lease(), logbook.decodes(), now)

    def post_mortem(self, *, short_of_memory: bool) -> Loss:
        """Return the cause of its end, and what it worked on.

        Only the death of a worker that decoded speaks against the video; otherwise the spec may be to blame.
        """
        loss, at = _cause(self.process.returncode, short_of_memory=short_of_memory), self.logbook.lease()
        return loss if at is None else replace(loss, lease=at, for_all=self.logbook.decodes())

    def end(self) -> None:
        """End and reap it."""
        self.process.kill()
        self.process.communicate()
        self.logbook.close()


@contextmanager
def start_ahead(config: ServeConfig) -> Iterator[list[WorkerProcess]]:
    """Start the workers of this host that a server begins with; at the end, end those that are left in the list."""
    standbys: list[WorkerProcess] = []
    try:
        with suppress(OSError):  # the pool starts the others, and reports why if it cannot
            while config.engine == "local" and len(standbys) < config.least_workers:
                standbys.append(WorkerProcess())
        yield standbys
    finally:
        for standby in standbys:
            standby.end()


def arguments(address: str, root: str, name: str, flags: Sequence[str], logbook: Logbook) -> list[str]:
    """Return the arguments of one worker, see :class:`WorkerProcess`."""
    return [
        *("--arenas-fd", str(logbook.arenas.fileno())),
        *("--connect", address, "--videos", root, "--name", name),
        *("--parent-pid", str(os.getpid())),
        *flags,
        *("--logbook-fd", str(logbook.descriptor)),
    ]


def _cause(returncode: int, *, short_of_memory: bool) -> Loss:
    if returncode >= 0:
        # An unhandled exception or a broken installation. The trace is on stderr; the cause is not known.
        return Loss(Cause.UNEXPLAINED, f"exited with status {returncode}")
    number = -returncode
    name = signal.Signals(number).name if number in set(signal.Signals) else f"signal {number}"
    if number in _CRASH_SIGNALS:
        return Loss(Cause.CRASHED, f"was ended by {name}")
    if number == signal.SIGKILL and short_of_memory:
        return Loss(Cause.MEMORY, f"was ended by {name} for lack of memory")
    if number in (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        return Loss(Cause.KILLED, f"was ended by {name} from outside")
    return Loss(Cause.UNEXPLAINED, f"was ended by {name}")


def queued_seconds(pid: int) -> float:
    """Return how long the first thread of a process, which does the work, has waited for a core since it started; 0 if
    the system does not say.
    """
    try:
        return int(Path(f"/proc/{pid}/schedstat").read_bytes().split()[1]) / 1e9
    except (OSError, IndexError, ValueError):
        return 0.0


def status_of(pid: int) -> str:
    """Return the status of a process in psutil's words: stopped, stopped by a debugger, waiting for a disk ..."""
    try:
        return str(psutil.Process(pid).status())
    except psutil.NoSuchProcess:
        return psutil.STATUS_DEAD


def make_host(
    config: ServeConfig,
    root: str,
    label: str,
    flags: Sequence[str],
    key: PeerKey | None,
    standbys: list[WorkerProcess] | None,
) -> LocalHost:
    """Return the host that the configuration asks for."""
    return LocalHost(root, flags, standbys)


class LocalHost:
    """This host.

    Args:
        root: the corpus, a folder or an address.
        flags: further flags of each worker.
        standbys: processes to use first.
        key: of the workers; None: they need none here, or the key that ``V2V_KEYS`` names.
    """

    is_local = True
    status_seconds = 1.0

    def __init__(
        self,
        root: str | os.PathLike[str],
        flags: Sequence[str] = (),
        standbys: list[WorkerProcess] | None = None,
        key: PeerKey | None = None,
    ) -> None:
        self.root = os.fspath(root)
        self.flags, self.key = flags, key
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
        self.child: WorkerProcess | None = None

    @property
    def is_running(self) -> bool:
        """Return whether its process runs."""
        return self.child is not None and self.child.process.poll() is None

    def start(self, name: str, address: str) -> None:
        """Start a worker that connects to ``address``.

        A host that has no more processes, files or memory for it does not end the workers that run, and does not count
        towards the crash budget.
        """
        host = self._host
        try:
            if host.standbys:
                standby = host.standbys.pop()
                standby.begin(arguments(address, host.root, name, host.flags, standby.logbook))
                self.child = standby
            else:
                self.child = WorkerProcess(address, host.root, name, host.flags, host.key)
        except OSError as error:
            loss = Loss(Cause.KILLED, f"could not be started: {error.strerror or error}")
            is_shortage = error.errno in _SHORTAGES
            self._failure = Exit(loss, retry_seconds=_AFTER_SHORTAGE_SECONDS if is_shortage else None)

    def take_exit(self) -> Exit | None:
        """Return once how the worker ended; None while it has not ended."""
        failure, self._failure = self._failure, None
        if self.child is None or (returncode := self.child.process.poll()) is None:
            return failure
        # The kernel counts a kill before its victim is gone, so it is included.
        loss = self.child.post_mortem(short_of_memory=self._host.is_short_of_memory())
        self.release()
        return Exit(loss, returncode)

    def status(self, now: float) -> ProcessStatus | None:
        """Observe the worker's process; None without one."""
        return None if self.child is None else self.child.status(now)

    def lend(self, arena: str) -> None:
        """Pass the worker the arena of its next lease."""
        if self.child is not None:
            self.child.logbook.lend(arena)

    def leave(self) -> bool:
        """Tell the worker to finish its sample and exit; return False if there is none to tell."""
        self.signal(signal.SIGTERM)
        return self.child is not None

    def signal(self, number: int) -> None:
        """Send the worker's process a signal, if it runs."""
        if self.child is not None:
            self.child.process.send_signal(number)

    def wait(self, seconds: float | None) -> bool:
        """Wait for the end of the worker's process, None: however long; return whether it has ended."""
        try:
            return (child := self.child) is None or child.process.wait(seconds) is not None
        except subprocess.TimeoutExpired:
            return False

    def release(self) -> None:
        """End and reap the worker's process, if there is one."""
        if self.child is not None:
            self.child.end()
            self.child = None
