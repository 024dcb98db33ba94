"""What processes use: processor time by role, and the most memory a process ever had."""

from __future__ import annotations

import os
import time
from collections.abc import Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil

from v2v_client.batch import Batch
from v2v_client.dataset import V2VStreamDataset
from v2v_client.local_server import LocalServer
from v2v_protocol.errors import UsageError

Roles = Mapping[str, Sequence[int]]
"""Process ids by what they do."""


def cpu_seconds(pid: int) -> float:
    """User and system time of all threads of a process so far.

    Raises:
        UsageError: it is gone: what it used cannot be known any more.
    """
    try:
        times = psutil.Process(pid).cpu_times()
    except psutil.NoSuchProcess as error:
        raise UsageError(f"process {pid} ended while it was measured") from error
    return times.user + times.system


def peak_rss_bytes(pid: int) -> int:
    """The most memory that was ever resident; where the system does not tell, what is resident now."""
    try:
        for line in Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) << 10
    except OSError:
        pass
    return int(psutil.Process(pid).memory_info().rss)


def roles_of(server: LocalServer) -> dict[str, list[int]]:
    """The broker (the server's main process), its workers, and this process as the client."""
    children = psutil.Process(server.pid).children()
    workers = [child.pid for child in children if "v2v_server.commands.worker" in child.cmdline()]
    return {"workers": workers, "broker": [server.pid], "client": [os.getpid()]}


class Meter:
    """Processor time since it was made, by role.

    Args:
        roles: whose. They live as long as they are measured.
    """

    def __init__(self, roles: Roles) -> None:
        self._roles = roles
        self._began = self._totals()

    def _totals(self) -> dict[str, float]:
        return {role: sum(map(cpu_seconds, pids)) for role, pids in self._roles.items()}

    def used(self) -> dict[str, float]:
        """CPU seconds of each role."""
        return {role: total - self._began[role] for role, total in self._totals().items()}


@dataclass(frozen=True, slots=True)
class Consumed:
    """What one measured stretch of a stream took.

    Attributes:
        batches: whole batches received.
        nbytes: of their tensors.
        seconds: wall time.
        cpu_seconds: by role.
    """

    batches: int
    nbytes: int
    seconds: float
    cpu_seconds: Mapping[str, float]

    @property
    def batches_per_second(self) -> float:
        return self.batches / self.seconds

    def cpu_seconds_per_batch(self, role: str | None = None) -> float:
        """Of one role, or of all of them."""
        return (sum(self.cpu_seconds.values()) if role is None else self.cpu_seconds[role]) / self.batches


def consume(dataset: V2VStreamDataset, roles: Roles, *, seconds: float, warmup_batches: int) -> Consumed:
    """Takes batches as fast as they come, over as many epochs as that takes.

    Args:
        dataset: to consume.
        roles: whose processor time is counted.
        seconds: from the end of the warm-up on.
        warmup_batches: taken before that.
    """
    batches = _endless(dataset)
    for _ in range(warmup_batches):
        next(batches)
    meter, began, taken, nbytes = Meter(roles), time.perf_counter(), 0, 0
    while True:
        nbytes += next(batches).nbytes
        taken += 1
        elapsed = time.perf_counter() - began
        if elapsed >= seconds:
            batches.close()
            return Consumed(taken, nbytes, elapsed, meter.used())


def _endless(dataset: Iterable[Batch]) -> Generator[Batch, None, None]:
    while True:
        yield from dataset
