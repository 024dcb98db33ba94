"""Workers as processes of this host. The process that starts them also reaps them.

Workers are started as programs of their own (never forked), in their own process group so that Ctrl-C in a terminal
reaches only the server, and die with the server even when it is killed. An actor on another host
(:mod:`v2v_server.supervise.ray_host`) starts them, and interprets their ends, in the same way.

Processes may be started before there is work: they import their modules while the server imports its own and opens its
catalogue. The pool then tells them their arguments, in place of starting other processes.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import psutil

from v2v_protocol.keys import PeerKey, nameless_key
from v2v_protocol.programs import environment
from v2v_server.broker.leases import Cause, Loss
from v2v_server.config import ServeConfig
from v2v_server.supervise.host import Exit, ProcessStatus
from v2v_server.worker.logbook import Logbook

STOPPED = (psutil.STATUS_STOPPED, psutil.STATUS_TRACING_STOP)
_CRASH_SIGNALS = (signal.SIGSEGV, signal.SIGBUS, signal.SIGABRT, signal.SIGILL, signal.SIGFPE)
PROGRAM = (sys.executable, "-m", "v2v_server.commands.worker")
_Process = subprocess.Popen[bytes]
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
_MEMORY_SECONDS = 5.0
"""Time after the kernel has killed a process for lack of memory in which a worker's SIGKILL is attributed to that."""
_SHORTAGES = (errno.EAGAIN, errno.ENOMEM, errno.EMFILE, errno.ENFILE)
_AFTER_SHORTAGE_SECONDS = 5.0


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


def start_child(
    address: str, root: str, name: str, flags: Sequence[str], logbook: Logbook, key: PeerKey | None = None
) -> _Process:
    """Start a worker in a process of its own, which dies with this one.

    Args:
        address: where the server listens for workers.
        root: the corpus, a folder or an address.
        name: unique name of the worker.
        flags: further flags.
        logbook: records the lease in work.
        key: its key, passed in an unnamed file: neither command line, environment nor disk shows it.

    Raises:
        OSError: it cannot be started.
    """
    with contextlib.ExitStack() as open_here:
        handed = [logbook.descriptor, logbook.arenas.fileno()]
        if key is not None:
            handed.append(open_here.enter_context(nameless_key(key)).fileno())
            flags = [*flags, "--keys", f"/dev/fd/{handed[-1]}"]
        return start_program(arguments(address, root, name, flags, logbook), handed)


def start_program(arguments: Sequence[str], handed: Sequence[int], stdin: int = subprocess.DEVNULL) -> _Process:
    """Start the program of a worker with these arguments, which has the descriptors ``handed``.

    Raises:
        OSError: it cannot be started.
    """
    return subprocess.Popen(
        [*PROGRAM, *arguments],
        stdin=stdin,
        pass_fds=handed,
        env=environment() | _ONE_THREAD,
        process_group=0,
    )


def arguments(address: str, root: str, name: str, flags: Sequence[str], logbook: Logbook) -> list[str]:
    """Return the arguments of one worker, see :func:`start_child`."""
    return [
        *("--arenas-fd", str(logbook.arenas.fileno())),
        *("--connect", address, "--videos", root, "--name", name),
        *("--parent-pid", str(os.getpid())),
        *flags,
        *("--logbook-fd", str(logbook.descriptor)),
    ]


def post_mortem(returncode: int, logbook: Logbook | None, *, short_of_memory: bool) -> Loss:
    """Return the cause of a worker's unexpected end, and what it worked on.

    Only the death of a worker that decoded speaks against the video; otherwise the spec may be to blame.
    """
    loss = _cause(returncode, short_of_memory=short_of_memory)
    if logbook is None or (at := logbook.lease()) is None:
        return loss
    return replace(loss, lease=at, for_all=logbook.decodes())


def _cause(returncode: int, *, short_of_memory: bool) -> Loss:
    if returncode >= 0:
        # An unhandled exception or a broken installation. The trace is on stderr; the cause is not known.
        return Loss(Cause.UNEXPLAINED, f"exited with status {returncode}")
    number = -returncode
    name = signal.Signals(number).name if number in set(signal.Signals) else f"signal {number}"
    if number in _CRASH_SIGNALS:
        return Loss(Cause.CRASHED, f"was ended by {name}")
    if number == signal.SIGKILL and short_of_memory:
        return Loss(Cause.UNEXPLAINED, f"was ended by {name} while the host ran out of memory")
    if number in (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        return Loss(Cause.KILLED, f"was ended by {name} from outside")
    return Loss(Cause.UNEXPLAINED, f"was ended by {name}")


def hung(status: str, reason: str, at: int | None, *, decodes: bool) -> Loss:
    """Return what it means that a worker is given up.

    Args:
        status: status of its process, in psutil's words.
        reason: what it did, in words.
        at: the lease in work by its logbook.
        decodes: whether it decodes a video, by its logbook.
    """
    if status in STOPPED:
        return Loss(Cause.KILLED, "was stopped from outside and killed")
    if status == psutil.STATUS_DISK_SLEEP:
        # If the server of a network file system is away, every worker waits, each at a sound clip.
        return Loss(Cause.UNEXPLAINED, f"waited for its storage and {reason}", at, decodes)
    return Loss(Cause.HUNG, reason, at, decodes)


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


def out_of_memory_kills() -> int:
    """Return how many processes the kernel of this host has killed for lack of memory; 0 if it does not say."""
    try:
        for line in Path("/proc/vmstat").read_text(encoding="ascii").splitlines():
            if line.startswith("oom_kill "):
                return int(line.split()[1])
    except OSError:
        pass
    return 0


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
