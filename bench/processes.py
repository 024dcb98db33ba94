"""Processes: CPU time by role, resident memory and the line through it over time, free ports.

The slope of memory is that of ordinary least squares, with one slope for all processes and an intercept for each (a
restarted server is another process):

    y_ij = a_i + b t_ij + e_ij

Neighbouring points are correlated, so the textbook standard error is far too small; it is multiplied by
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
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import psutil

from v2v_client.batch import Batch
from v2v_client.dataset import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.errors import UsageError

MIB = float(1 << 20)
_PORTS = range(20_000, 30_000)
"""Below the ports of outgoing connections. Otherwise a consumer that reconnects to a dead server's port may get that
port for its own end, connect to itself and occupy the address (TCP simultaneous open)."""
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
    lines = Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines()
    return int(next(line for line in lines if line.startswith("VmHWM:")).split()[1]) << 10


def roles_of(server: LocalServer) -> dict[str, list[int]]:
    """Return the processes of the broker (the server's main process), its workers, and the client (this process)."""
    children = psutil.Process(server.pid).children()
    workers = [child.pid for child in children if "v2v_server.commands.worker" in child.cmdline()]
    return {"workers": workers, "broker": [server.pid], "client": [os.getpid()]}


def cpu_seconds_of(roles: Roles) -> dict[str, float]:
    """Return the processor time of each role so far; all processes must live."""
    return {role: sum(map(cpu_seconds, pids)) for role, pids in roles.items()}


@dataclass(frozen=True, slots=True)
class Consumed:
    """One measured stretch of a stream.

    Attributes:
        batches: received.
        nbytes: of their tensors.
        seconds: by the clock.
        cpu_seconds: by role.
    """

    batches: int
    nbytes: int
    seconds: float
    cpu_seconds: Mapping[str, float]

    @property
    def batches_per_second(self) -> float:
        """Return the rate by the clock."""
        return self.batches / self.seconds

    def cpu_seconds_per_batch(self, role: str | None = None) -> float:
        """Return the CPU seconds a batch of one role, or of all."""
        return (sum(self.cpu_seconds.values()) if role is None else self.cpu_seconds[role]) / self.batches


def consume(dataset: V2VStreamDataset, roles: Roles, *, seconds: float, warmup_batches: int) -> Consumed:
    """Consume batches as fast as they come, over as many epochs as needed; count after the warm-up."""
    batches = endless(dataset)
    for _ in range(warmup_batches):
        next(batches)
    before, began, taken, nbytes = cpu_seconds_of(roles), time.perf_counter(), 0, 0
    while True:
        nbytes += next(batches).nbytes
        taken += 1
        elapsed = time.perf_counter() - began
        if elapsed >= seconds:
            batches.close()
            used = {role: total - before[role] for role, total in cpu_seconds_of(roles).items()}
            return Consumed(taken, nbytes, elapsed, used)


def endless(dataset: Iterable[Batch]) -> Generator[Batch, None, None]:
    """Yield the batches of one epoch after the other."""
    while True:
        yield from dataset


@dataclass(frozen=True, slots=True)
class Fit:
    """A line through memory over time.

    Attributes:
        slope: MiB a minute.
        standard_error: of the slope.
        residual: standard deviation of the residuals, MiB.
        points, series: numbers used.
        first, last, most: MiB at both ends of the last series, and the most in any.
    """

    slope: float
    standard_error: float
    residual: float
    points: int
    series: int
    first: float
    last: float
    most: float


def fit(series: Sequence[Series], *, skip_seconds: float = 0.0) -> Fit:
    """Fit the common slope of several series.

    Args:
        series: of each process.
        skip_seconds: warm-up at the beginning of each; series with fewer than three later points are left out.

    Raises:
        UsageError: no series is left.
    """
    used = []
    for each in series:
        points = np.array(each, dtype=np.float64).reshape(-1, 2)
        points = points[points[:, 0] - points[:1, 0] >= skip_seconds]
        if len(points) >= 3 and np.ptp(points[:, 0]) > 0:
            used.append(points)
    if not used:
        raise UsageError(f"no process has three points after {skip_seconds:g} s of warm-up: run for longer")
    centred = [points - points.mean(axis=0) for points in used]
    both = np.concatenate(centred)
    spread = float(both[:, 0] @ both[:, 0])
    slope = float(both[:, 0] @ both[:, 1]) / spread
    residuals = [points[:, 1] - slope * points[:, 0] for points in centred]
    error = np.concatenate(residuals)
    freedom = max(1, len(error) - len(used) - 1)
    variance = float(error @ error) / freedom
    r = _autocorrelation(residuals)
    widened = math.sqrt(variance / spread * (1 + r) / (1 - r))
    return Fit(
        slope=60.0 * slope,
        standard_error=60.0 * widened,
        residual=math.sqrt(variance),
        points=len(error),
        series=len(used),
        first=float(used[-1][0, 1]),
        last=float(used[-1][-1, 1]),
        most=max(float(points[:, 1].max()) for points in used),
    )


def _autocorrelation(residuals: Sequence[npt.NDArray[np.float64]]) -> float:
    """Return the lag-one autocorrelation over all series, at least 0: a negative one would narrow the error."""
    power = sum(float(each @ each) for each in residuals)
    lagged = sum(float(each[:-1] @ each[1:]) for each in residuals)
    return min(max(lagged / power, 0.0), _MOST_AUTOCORRELATION) if power > 0 else 0.0


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
