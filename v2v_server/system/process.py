"""Services of the operating system: memory that stays, cores, long time slices, children that die with their parent
and have no terminal, locks, private files.
"""

from __future__ import annotations

import atexit
import ctypes
import errno
import fcntl
import gc
import math
import os
import platform
import resource
import signal
import stat
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache, partial
from pathlib import Path
from socket import SHUT_WR, socket, socketpair
from threading import Thread

from v2v_protocol import arena
from v2v_protocol.errors import CorpusError, undo_on_error
from v2v_protocol.programs import printable

_PR_SET_PDEATHSIG = 1
_TURN_SECONDS = 0.1  # the longest time slice that Linux grants
MOST_CONNECTIONS = 4096 + 256
_MOST_FILES = 1 << 16  # one connection per consumer and worker, and one logbook per worker
_SCHED_ATTR_CALLS = {"x86_64": (315, 314), "aarch64": (275, 274)}  # numbers of sched_getattr and sched_setattr
_LONGEST_PAUSE_SECONDS, _LOCKED = 0.05, "another process keeps it locked; end that process"
_NO_LIMIT_BYTES = 1 << 60
"""Version 1 of control groups states a number above this one in place of no limit."""


def keep_freed_memory() -> bool:
    """Call :func:`v2v_protocol.arena.keep_freed_memory` for blocks of the size of a sample; a server or worker
    returns larger free memory.
    """
    return arena.keep_freed_memory(most_bytes=arena.LARGEST_SAMPLE_BYTES)


class _SchedAttr(ctypes.Structure):
    """struct sched_attr of sched_setattr(2), as in its first version."""

    _fields_ = (
        ("size", ctypes.c_uint32),
        ("policy", ctypes.c_uint32),
        ("flags", ctypes.c_uint64),
        ("nice", ctypes.c_int32),
        ("priority", ctypes.c_uint32),
        ("runtime_ns", ctypes.c_uint64),
        ("deadline_ns", ctypes.c_uint64),
        ("period_ns", ctypes.c_uint64),
    )


def take_long_turns() -> bool:
    """Ask for long time slices on a core for the calling thread, instead of 3 ms, if threads share a core.

    Each time slice starts with caches full of another process's pictures. The thread's share of the core stays the
    same, and processes that wake briefly (broker, client, trainer) run sooner, not later.

    Returns:
        False if the system does not support it or this thread has another scheduling class; then nothing was changed.
        Linux before 6.12 accepts the request and ignores it.
    """
    calls = _SCHED_ATTR_CALLS.get(platform.machine()) if sys.platform.startswith("linux") else None
    if calls is None:
        return False
    kernel, attributes = ctypes.CDLL(None), _SchedAttr()
    get, set_ = map(ctypes.c_long, calls)
    if kernel.syscall(get, 0, ctypes.byref(attributes), ctypes.c_uint(ctypes.sizeof(attributes)), 0) != 0:
        return False
    if attributes.policy not in (os.SCHED_OTHER, os.SCHED_BATCH):
        return False
    attributes.runtime_ns = round(_TURN_SECONDS * 1e9)
    return bool(kernel.syscall(set_, 0, ctypes.byref(attributes), 0) == 0)


def open_many_files() -> None:
    """Raise this process's limit of open files and connections to the system's limit, up to what a server can need.

    The default is 1024, for the sake of programs that use select(2). At the limit ZeroMQ silently accepts no more
    peers, or ends the process when a local worker connects.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = _MOST_FILES if hard == resource.RLIM_INFINITY else min(hard, _MOST_FILES)
    if soft != resource.RLIM_INFINITY and soft < most:
        with suppress(OSError, ValueError):  # a system may allow fewer than it reports
            resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))


def most_connections(files_for_others: int) -> int:
    """Return the number of connections that leaves at least half of this process's descriptors to everything else.

    Args:
        files_for_others: descriptors that workers take.
    """
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY:
        return MOST_CONNECTIONS
    return max(1, min(MOST_CONNECTIONS, (soft - files_for_others) // 2))


def limit_memory(most_bytes: int) -> None:
    """Limit the memory that this process may allocate. Larger requests fail, such as those of a decoder for a file that
    claims a huge size.

    Memory shared with other processes (a consumer's slots) and memory that is only reserved do not count.

    Args:
        most_bytes: the limit; a lower existing limit stays.
    """
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    at_most = most_bytes if hard == resource.RLIM_INFINITY else min(most_bytes, hard)
    resource.setrlimit(resource.RLIMIT_DATA, (at_most, hard))


def limit_processor_time(seconds: float) -> None:
    """Limit the processor time of this process from now on; the kernel ends it (SIGXCPU) if it takes more, for instance
    in a decoder that loops without end. Call again before each piece of work.

    Args:
        seconds: the limit; a lower existing limit stays.
    """
    _, hard = resource.getrlimit(resource.RLIMIT_CPU)
    at_most = math.ceil(time.process_time() + seconds)
    resource.setrlimit(resource.RLIMIT_CPU, (at_most if hard == resource.RLIM_INFINITY else min(at_most, hard), hard))


def usable_cores() -> int:
    """Return how many cores this process may use: those that a batch system, a container or ``taskset`` assigned to it,
    limited by the container's processor time; the cores of the machine if the system reports no limit.
    """
    has_affinity = hasattr(os, "sched_getaffinity")
    cores = len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1
    return max(1, min(cores, math.ceil(min(_granted_cores(), cores))))


def control_groups(groups: Path = Path("/sys/fs/cgroup"), own: Path = Path("/proc/self/cgroup")) -> Iterator[Path]:
    """Yield the folders of this process's control groups and those above them, the topmost first (Linux): that of
    version 2, and those of each controller of version 1. A container sees only some of them.
    """
    with suppress(OSError, ValueError):
        for line in own.read_text(encoding="utf-8").splitlines():
            _, controllers, path = line.split(":", 2)
            # A hierarchy of several controllers is mounted under all their names, with a link for each.
            for name in dict.fromkeys((controllers, *controllers.split(","))):
                folder = groups / name
                for part in ("", *path.strip("/").split("/")):
                    folder = folder / part
                    yield folder


def _granted_cores(*where: Path) -> float:
    """Return the processor time that this process and its siblings may use per second. It is the strictest limit of its
    control groups: ``docker run --cpus``, a pod's limit, CPUQuota of systemd.

    Args:
        where: see :func:`control_groups`.

    Returns:
        seconds per second; infinite without a limit.
    """
    least = math.inf
    for folder in control_groups(*where):
        for files in (("cpu.max",), ("cpu.cfs_quota_us", "cpu.cfs_period_us")):  # version 2, version 1
            with suppress(OSError, ValueError):  # "max", or a folder without these files
                quota, period = (int(word) for file in files for word in (folder / file).read_text("utf-8").split())
                least = min(least, quota / period if min(quota, period) > 0 else math.inf)  # -1: no limit
    return least


def control_group_memory(*where: Path) -> list[tuple[int, int]]:
    """Return (limit, free), bytes, of each control group of this process that has a limit.

    Args:
        where: see :func:`control_groups`.
    """
    limits = list[tuple[int, int]]()
    for folder in control_groups(*where):
        for files in (("memory.max", "memory.current"), ("memory.limit_in_bytes", "memory.usage_in_bytes")):
            with suppress(OSError, ValueError):  # "max", or a folder without these files
                limit, used = (int((folder / file).read_text("ascii")) for file in files)
                if limit < _NO_LIMIT_BYTES:
                    limits.append((limit, limit - used))
    return limits


def memory_limit(*where: Path) -> int:
    """Return the most memory that this process may use, bytes: the strictest limit of its control groups, at most the
    memory of the host.

    Args:
        where: see :func:`control_groups`.
    """
    host = os.sysconf("SC_PHYS_PAGES") * resource.getpagesize()
    return min([host, *(limit for limit, _ in control_group_memory(*where))])


def out_of_memory_kills(*where: Path, host: Path = Path("/proc/vmstat")) -> int:
    """Return how many processes the kernel has killed for lack of memory, on this host and in the control groups of
    this process; 0 if it does not say. A kill may count twice.

    Args:
        where: see :func:`control_groups`.
        host: file with the counters of the host.
    """
    kills = 0
    groups = [folder / name for folder in control_groups(*where) for name in ("memory.events", "memory.oom_control")]
    for file in (host, *groups):
        with suppress(OSError, ValueError):
            kills += sum(int(line[9:]) for line in file.read_text("ascii").splitlines() if line.startswith("oom_kill "))
    return kills


@contextmanager
def without_collections() -> Iterator[None]:
    """Disable Python's search for reference cycles meanwhile. While a million lasting objects are created, it would
    examine them repeatedly, which takes longer than creating them.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def resident_bytes() -> int:
    """Return the resident memory of this process, including shared pages, bytes; 0 if the system does not report it
    (Linux does).
    """
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except (OSError, ValueError, IndexError):
        return 0
    return pages * resource.getpagesize()


def give_way() -> None:
    """Yield this core to waiting processes at a convenient moment, instead of at the end of the time slice."""
    if hasattr(os, "sched_yield"):
        os.sched_yield()


def die_with_parent(parent_pid: int) -> None:
    """Make the kernel kill this process when its parent dies, even by SIGKILL (Linux; no effect elsewhere).

    Args:
        parent_pid: process id of the parent when this process was started; if it is gone already, this process exits.
    """
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent_pid:
        os._exit(1)


@cache
def relayed_output() -> socket:
    """Return what children without a terminal print to. A thread of this process writes each line to standard error,
    without characters that steer a terminal.
    """
    ours, childrens = socketpair()
    ours.shutdown(SHUT_WR)  # there is nothing to read, where it is standard input too

    def write_lines() -> None:
        with ours.makefile("rb") as output, suppress(OSError):  # our own standard error is closed
            while line := output.readline(1 << 14):
                # Not through sys.stderr: the interpreter could not end while this thread has its lock.
                os.write(2, f"{printable(os.fsdecode(line.rstrip()))}\n".encode())

    thread = Thread(target=write_lines, name="v2v-output", daemon=True)
    thread.start()
    atexit.register(thread.join, 1.0)
    atexit.register(childrens.close)  # before that
    return childrens


def cache_folder(chosen: str | os.PathLike[str] | None = None) -> Path:
    """Return the folder for this user's indexes and copies: the chosen one, else ``$V2V_CACHE_DIR``, else
    ``$XDG_CACHE_HOME/v2v``, else ``~/.cache/v2v``.

    Raises:
        CorpusError: no folder was chosen, and this user has no home folder.
    """
    if chosen is None:
        chosen = os.environ.get("V2V_CACHE_DIR") or None
    if chosen is not None:
        return Path(chosen)
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "v2v"
    except RuntimeError as error:  # neither HOME nor an entry in the user database, as in some containers
        raise CorpusError(
            f"user {os.getuid()} has no home folder for the catalogue's index: give a folder with --cache-dir or "
            "V2V_CACHE_DIR"
        ) from error


@contextmanager
def locked(file: Path, wait_seconds: float = 0.0) -> Iterator[None]:
    """Hold a lock, until the end of the body or of this process.

    A file that can be opened can be locked, for reading too, by a confined process or another user. So the file holds
    nothing else, and only our own user can open it, to write (root can always open it).

    Args:
        file: the lock; created if it is missing.
        wait_seconds: longest wait for another process; 0 tries once.

    Raises:
        BlockingIOError: another process keeps it locked.
        OSError: it cannot be opened, or the file system has no locks.
    """
    pause, end = 0.001, time.monotonic() + wait_seconds
    with open(open_private(file, os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW, 0o200), "wb") as held:
        while True:
            try:
                fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() >= end:
                    raise BlockingIOError(errno.EAGAIN, _LOCKED, str(file)) from None
            time.sleep(pause)
            pause = min(2 * pause, _LONGEST_PAUSE_SECONDS)
        yield


def open_private(path: Path, flags: int, mode: int = 0o600) -> int:
    """Open a regular file of ours, and return its descriptor. Never blocks.

    Args:
        path: the file. Other users lose access to an existing file, unless it lies behind a symbolic link.
        flags: of ``os.open``; with ``O_CREAT`` a missing file is made.
        mode: all that its permissions may be.

    Raises:
        OSError: the file cannot be opened, or is not a regular one.
    """
    descriptor = os.open(path, flags | os.O_CLOEXEC | os.O_NONBLOCK, mode)
    with undo_on_error(partial(os.close, descriptor)):
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise OSError(errno.EINVAL, "not a regular file", str(path))
        is_open = stat.S_IMODE(status.st_mode) & ~mode
        if status.st_uid == os.geteuid() and is_open and not path.is_symlink():
            os.fchmod(descriptor, mode)
    return descriptor


def make_private(path: Path) -> None:
    """Make an empty file with mode 0600; an existing file keeps its content.

    Raises:
        OSError: the file cannot be made, or is not a regular one.
    """
    os.close(open_private(path, os.O_RDWR | os.O_CREAT))
