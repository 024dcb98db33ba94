"""One worker's process: how it is started, what it is at, and what its end means. Whoever has processes uses it: the
local pool, and an engine's actor on another host."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import psutil

from v2v_protocol.keys import PeerKey, nameless_key
from v2v_protocol.programs import environment
from v2v_server.broker.blame import Cause, Loss
from v2v_server.worker.logbook import Logbook

STOPPED = (psutil.STATUS_STOPPED, psutil.STATUS_TRACING_STOP)
_CRASH_SIGNALS = (signal.SIGSEGV, signal.SIGBUS, signal.SIGABRT, signal.SIGILL, signal.SIGFPE)
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")


def start_child(
    address: str, root: str, name: str, flags: Sequence[str], logbook: Logbook, key: PeerKey | None = None
) -> subprocess.Popen[bytes]:
    """A worker in a process of its own, which dies with this one.

    Args:
        address: where the server listens for workers.
        root: the corpus, a folder or an address.
        name: of the worker, which no other has.
        flags: more of them.
        logbook: for the lease it is at.
        key: its key, which it gets in a nameless file: neither command line, environment nor disk shows it.

    Raises:
        OSError: it cannot be started.
    """
    with contextlib.ExitStack() as open_here:
        handed = [logbook.descriptor]
        if key is not None:
            handed.append(open_here.enter_context(nameless_key(key)).fileno())
            flags = [*flags, "--keys", f"/dev/fd/{handed[-1]}"]
        return subprocess.Popen(
            [*command(address, root, name), *flags, "--logbook-fd", str(logbook.descriptor)],
            stdin=subprocess.DEVNULL,
            pass_fds=handed,
            env=environment() | _ONE_THREAD,
            process_group=0,
        )


def command(address: str, root: str, name: str) -> list[str]:
    """The program of one worker."""
    return [
        *(sys.executable, "-m", "v2v_server.commands.worker"),
        *("--connect", address, "--videos", root, "--name", name),
        *("--parent-pid", str(os.getpid())),
    ]


def post_mortem(returncode: int, *, short_of_memory: bool) -> Loss:
    """What the end of a worker means that was not asked for."""
    if returncode >= 0:
        # An exception nobody foresaw, a broken installation: the trace is on stderr, whose fault it is is not.
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
    """What it means that a worker is given up.

    Args:
        status: of its process, in psutil's words.
        reason: what it did, in words.
        at: the lease it is at by its logbook.
        decodes: whether it decodes a video, by its logbook.
    """
    if status in STOPPED:
        return Loss(Cause.KILLED, "was stopped from outside and killed")
    if status == psutil.STATUS_DISK_SLEEP:
        # A network file system whose server is away holds every worker at whatever clip it has.
        return Loss(Cause.UNEXPLAINED, f"waited for its storage and {reason}", at, decodes)
    return Loss(Cause.HUNG, reason, at, decodes)


def is_stopped(pid: int) -> bool:
    """By its own words, which are cheap to ask a thousand workers for."""
    try:
        state = Path(f"/proc/{pid}/stat").read_bytes().rpartition(b") ")[2][:1]
    except OSError:
        return sys.platform != "linux" and status_of(pid) in STOPPED
    return state in (b"T", b"t")


def queued_seconds(pid: int) -> float:
    """How long a process has waited for a core since it began, its first thread alone: that which works. 0 where the
    system does not say."""
    try:
        return int(Path(f"/proc/{pid}/schedstat").read_bytes().split()[1]) / 1e9
    except (OSError, IndexError, ValueError):
        return 0.0


def status_of(pid: int) -> str:
    """What a process is at, in psutil's words: stopped, also by a debugger, or in the kernel, waiting for a disk ..."""
    try:
        return str(psutil.Process(pid).status())
    except psutil.NoSuchProcess:
        return psutil.STATUS_DEAD


def out_of_memory_kills() -> int:
    """How many processes the kernel of this host has killed for want of memory; 0 where it does not say."""
    try:
        for line in Path("/proc/vmstat").read_text(encoding="ascii").splitlines():
            if line.startswith("oom_kill "):
                return int(line.split()[1])
    except OSError:
        pass
    return 0
