"""Processes: CPU time by role, resident memory and the line through it over time, free ports.

The slope of memory is that of ordinary least squares. Neighbouring points are correlated, so the textbook standard
error is far too small; it is multiplied by
sqrt((1 + r) / (1 - r)), where r is the lag-one autocorrelation of the residuals (the effective sample size of an AR(1)
process; von Storch and Zwiers, "Statistical Analysis in Climate Research", 1999, section 6.6).
"""

from __future__ import annotations

import math
import os
import random
import socket
import time
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
import psutil

from v2v_client.batch import Batch
from v2v_client.dataset import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.errors import UsageError

MIB = float(1 << 20)
# Below the ports of outgoing connections. Otherwise a consumer that reconnects to a dead server's port may get that
# port for its own end, connect to itself and occupy the address (TCP simultaneous open).
_PORTS = range(20_000, 30_000)
_MOST_AUTOCORRELATION = 0.99
Series = Sequence[tuple[float, float]]  # (seconds, MiB) of one process
Roles = Mapping[str, Sequence[int]]  # Process ids by role


def cpu_seconds(pid: int) -> float:
    """Return the user and system time of all threads of a process.

    Raises:
        UsageError: the process has ended, so its time is unknown.
    """
    try:
        times = psutil.Process(pid).cpu_times()
    except psutil.NoSuchProcess as error:
        raise UsageError(f"process {pid} ended while it was measured") from error
    return times.user + times.system


def peak_rss_bytes(pid: int) -> int:
    """Return the peak resident memory of a process, from /proc."""
    return int(Path(f"/proc/{pid}/status").read_text(encoding="ascii").partition("VmHWM:")[2].split()[0]) << 10


def workers_of(pid: int) -> list[int]:
    """Return the worker processes of a server's main process; none once it has ended."""
    try:
        children = psutil.Process(pid).children()
        return [child.pid for child in children if "v2v_server.commands.worker" in child.cmdline()]
    except (psutil.NoSuchProcess, psutil.ZombieProcess):
        return []


def roles_of(server: LocalServer) -> dict[str, list[int]]:
    """Return the processes of the broker (the server's main process), its workers, and the client (this process)."""
    return {"workers": workers_of(server.pid), "broker": [server.pid], "client": [os.getpid()]}


def cpu_seconds_of(roles: Roles) -> dict[str, float]:
    """Return the processor time of each role so far; all processes must live."""
    return {role: sum(map(cpu_seconds, pids)) for role, pids in roles.items()}


def consume(dataset: V2VStreamDataset, roles: Roles, *, seconds: float, warmup_batches: int) -> dict[str, float]:
    """Consume batches as fast as they come, over as many epochs as needed; count after the warm-up.

    Returns:
        a flat record: batches, bytes of their tensors, seconds and rates by the clock, processor time of each role.
    """
    batches = endless(dataset)
    for _ in range(warmup_batches):
        next(batches)
    before, began, taken, nbytes = cpu_seconds_of(roles), time.perf_counter(), 0, 0
    while (elapsed := time.perf_counter() - began) < seconds or not taken:
        nbytes += next(batches).nbytes
        taken += 1
    batches.close()
    after = cpu_seconds_of(roles)
    return {
        "batches": taken,
        "bytes": nbytes,
        "seconds": elapsed,
        "batches_per_second": taken / elapsed,
        "bytes_per_second": nbytes / elapsed,
        **{f"{role}_cpu_seconds_per_batch": (after[role] - before[role]) / taken for role in roles},
    }


def endless(dataset: Iterable[Batch]) -> Generator[Batch, None, None]:
    """Yield the batches of one epoch after the other."""
    while True:
        yield from dataset


class Fit(NamedTuple):
    """Slope of a line through memory over time, and its standard error, MiB a minute."""

    slope: float
    standard_error: float


def fit(series: Series) -> Fit:
    """Fit a line to memory over time.

    Raises:
        UsageError: there are fewer than three points.
    """
    if len(series) < 3:
        raise UsageError(f"a process has {len(series)} points after its warm-up; three are needed: run for longer")
    seconds, mib = np.array(series, dtype=np.float64).T
    slope, start = np.polyfit(seconds, mib, 1)
    residuals = mib - start - slope * seconds
    power = float(residuals @ residuals)
    # A negative autocorrelation would narrow the error.
    r = np.clip(residuals[:-1] @ residuals[1:] / power, 0.0, _MOST_AUTOCORRELATION) if power > 0 else 0.0
    variance = power / max(1, len(seconds) - 2) / (len(seconds) * np.var(seconds))
    return Fit(60.0 * float(slope), 60.0 * math.sqrt(variance * (1 + r) / (1 - r)))


def rss_mib(pid: int) -> float | None:
    """Return the resident memory of a process, MiB; None when it has ended (a zombie has none)."""
    try:
        resident = psutil.Process(pid).memory_info().rss
    except psutil.NoSuchProcess:
        return None
    return resident / MIB if resident else None


def last_in_line() -> None:
    """Give the calling process the lowest priority; for a new process, before its program."""
    os.nice(19)
    with suppress(OSError):  # sessions have their own share where the kernel groups them
        Path("/proc/self/autogroup").write_text("19", encoding="ascii")


def free_ports(count: int) -> list[int]:
    """Return free ports.

    Raises:
        UsageError: there are fewer free ports.
    """
    found: list[int] = []
    for port in random.sample(_PORTS, len(_PORTS)):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
        found.append(port)
        if len(found) == count:
            return found
    raise UsageError(f"no free port from {_PORTS[0]} to {_PORTS[-1]}")
