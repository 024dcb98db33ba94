"""What we ask of the operating system: memory that stays, cores, long turns, children that die with their parent."""

from __future__ import annotations

import ctypes
import gc
import math
import os
import platform
import resource
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from v2v_protocol import allocator
from v2v_protocol.errors import CorpusError

_PR_SET_PDEATHSIG = 1
_TURN_SECONDS = 0.1  # the longest that Linux grants
_MOST_FILES = 1 << 16  # a connection of each consumer and worker that a server takes, and a logbook of each worker
_SCHED_ATTR_CALLS = {"x86_64": (315, 314), "aarch64": (275, 274)}  # numbers of sched_getattr and sched_setattr


def keep_freed_memory() -> bool:
    """:func:`v2v_protocol.allocator.keep_freed_memory` for blocks of the size of a sample: what is free beyond that, a
    server or worker gives back."""
    return allocator.keep_freed_memory(most_bytes=allocator.LARGEST_SAMPLE_BYTES)


class _SchedAttr(ctypes.Structure):
    """struct sched_attr of sched_setattr(2), as far as the first version goes."""

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
    """Ask for long turns on a core for the calling thread, instead of 3 ms, where several have to share one.

    Each turn begins with the caches full of somebody else's pictures. Its share of the core stays what it was, and
    whoever wakes for a short moment (broker, client, trainer) comes sooner, not later.

    Returns:
        False where the system knows nothing of the kind, or this thread is not scheduled in the usual way: nothing was
        changed. Linux before 6.12 takes the wish and does nothing with it.
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
    """Let this process have as many files and connections open as the system allows, up to what a server can need.

    By default that is 1024, for the sake of programs that use select(2). With all of them taken ZeroMQ lets nobody in
    any more, without a word, or ends the process when a local worker connects.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = _MOST_FILES if hard == resource.RLIM_INFINITY else min(hard, _MOST_FILES)
    if soft != resource.RLIM_INFINITY and soft < most:
        with suppress(OSError, ValueError):  # a system may allow fewer than it says
            resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))


def limit_memory(most_bytes: int) -> None:
    """More is refused to whatever in this process asks for it: a decoder, by a file that claims what it has not.

    What is shared with other processes does not count (a consumer's slots), nor what is only reserved.

    Args:
        most_bytes: at most; a lower limit that the process has already stays.
    """
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    at_most = most_bytes if hard == resource.RLIM_INFINITY else min(most_bytes, hard)
    resource.setrlimit(resource.RLIMIT_DATA, (at_most, hard))


def limit_processor_time(seconds: float) -> None:
    """From now on this process may take so much processor time, and is ended by the kernel (SIGXCPU) if it takes more:
    a decoder that goes round in circles does so at the machine's expense. To be called again before each piece of work.

    Args:
        seconds: at most; a lower limit that the process has already stays.
    """
    _, hard = resource.getrlimit(resource.RLIMIT_CPU)
    at_most = math.ceil(time.process_time() + seconds)
    resource.setrlimit(resource.RLIMIT_CPU, (at_most if hard == resource.RLIM_INFINITY else min(at_most, hard), hard))


def usable_cores() -> int:
    """How many cores this process may use: those that a batch system, a container or ``taskset`` gave it, and no more
    than the processor time that a container may spend amounts to; those of the machine where the system does not say.
    """
    has_affinity = hasattr(os, "sched_getaffinity")
    cores = len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1
    return max(1, min(cores, math.ceil(min(_granted_cores(), cores))))


def _granted_cores(groups: Path = Path("/sys/fs/cgroup"), own: Path = Path("/proc/self/cgroup")) -> float:
    """Processor time that this process and its siblings are granted in a second, the strictest limit of its control
    group (Linux, version 2) and of those above it: ``docker run --cpus``, a pod's limit, CPUQuota of systemd.

    Returns:
        seconds a second; infinite without a limit.
    """
    try:
        (path,) = (line[3:] for line in own.read_text(encoding="utf-8").splitlines() if line.startswith("0::"))
    except (OSError, ValueError):
        return math.inf
    least, folder = math.inf, groups
    for part in ("", *path.strip("/").split("/")):
        folder = folder / part
        try:
            quota, period = (folder / "cpu.max").read_text(encoding="utf-8").split()
        except (OSError, ValueError):
            continue  # the topmost group has none
        if quota != "max":
            least = min(least, int(quota) / int(period))
    return least


@contextmanager
def without_collections() -> Iterator[None]:
    """Python looks for no reference cycles meanwhile. Where a million objects are made that all stay, it would look
    through them again and again, which takes longer than to make them."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def resident_bytes() -> int:
    """Memory of this process, shared pages too; 0 where the system does not say (Linux says)."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except (OSError, ValueError, IndexError):
        return 0
    return pages * resource.getpagesize()


def give_way() -> None:
    """Let others have this core at a good moment, where any are waiting, instead of at the end of the turn."""
    if hasattr(os, "sched_yield"):
        os.sched_yield()


def die_with_parent(parent_pid: int) -> None:
    """Make the kernel kill this process when its parent dies, even by SIGKILL (Linux; elsewhere nothing happens).

    Args:
        parent_pid: who the parent was when this process was started; if it is gone already, so are we.
    """
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent_pid:
        os._exit(1)


def cache_folder(chosen: str | os.PathLike[str] | None = None) -> Path:
    """Where this user's indexes and copies lie: what was chosen, else ``$V2V_CACHE_DIR``, else
    ``$XDG_CACHE_HOME/v2v``, else ``~/.cache/v2v``.

    Raises:
        CorpusError: none was chosen, and this user has no home folder.
    """
    if chosen is None:
        chosen = os.environ.get("V2V_CACHE_DIR") or None
    if chosen is not None:
        return Path(chosen)
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "v2v"
    except RuntimeError as error:  # neither HOME nor an entry in the list of users: a container's user, say
        raise CorpusError(
            f"user {os.getuid()} has no home folder to keep the catalogue's index in: say where with --cache-dir or "
            "V2V_CACHE_DIR"
        ) from error
