"""The seam between the pool of workers and the hosts that run their processes.

The pool (:mod:`v2v_server.supervise.pool`) decides when a worker starts, leaves or is given up. A host knows how: as
processes of this host (:mod:`v2v_server.supervise.local_host`) or on a Ray cluster
(:mod:`v2v_server.supervise.ray_host`). No method waits for a worker, except ``wait``, ``release`` and ``close``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

from v2v_server.broker.leases import Loss


@dataclass(frozen=True, slots=True)
class ProcessStatus:
    """A worker's process, as its host sees it.

    Attributes:
        status: of the process, in psutil's words.
        queued_seconds: time that it has waited for a core since it started.
        lease: the lease in work by its logbook, 0 for no lease; None if it never wrote one.
        decodes: whether it decodes a video, by its logbook.
        seen_at: monotonic time of the observation, seconds.
    """

    status: str = ""
    queued_seconds: float = 0.0
    lease: int | None = None
    decodes: bool = False
    seen_at: float = 0.0


@dataclass(frozen=True, slots=True)
class Exit:
    """End of a worker's process, or a start that failed.

    Attributes:
        loss: what it says about the sample in work.
        returncode: exit status of the process; None if it is not known.
        retry_seconds: time until the next start; None: the usual delay, which grows with every loss in a row.
        is_loss: whether a worker was lost; False if it had not started.
    """

    loss: Loss
    returncode: int | None = None
    retry_seconds: float | None = None
    is_loss: bool = True


class WorkerPlace(Protocol):
    """Where the worker of one slot runs."""

    @property
    def is_running(self) -> bool:
        """Return whether its process runs, as far as is known."""

    def start(self, name: str, address: str) -> None:
        """Start a worker that connects to ``address``. A failure is reported by :meth:`take_exit`."""

    def take_exit(self) -> Exit | None:
        """Return once how the worker ended; None while it has not ended."""

    def status(self, now: float) -> ProcessStatus | None:
        """Return the latest observation of the worker's process; None without one."""

    def lend(self, arena: str) -> None:
        """Pass the worker the arena of its next lease, if it is a process of this host."""

    def leave(self) -> bool:
        """Tell the worker to finish its sample and exit; return False if there is none to tell."""

    def signal(self, number: int) -> None:
        """Send the worker's process a signal, if it runs."""

    def release(self) -> None:
        """End the worker's process, if it runs, and give the place up."""


AnyPlace = TypeVar("AnyPlace", bound=WorkerPlace)


class Host(Protocol[AnyPlace]):
    """Runs workers' processes.

    Attributes:
        is_local: whether all workers run on this host.
        status_seconds: time from one observation of a process to the next.
    """

    is_local: bool
    status_seconds: float

    def place(self, number: int) -> AnyPlace:
        """Return a place for the worker of a slot."""

    def request(self, workers: int) -> None:
        """Note how many workers there should be."""

    def refresh(self, now: float) -> None:
        """Read what has happened since the last call. Called a few times a second."""

    def wait(self, places: Sequence[AnyPlace], seconds: float) -> list[AnyPlace]:
        """Wait until the workers have ended; return the places of those that have not."""

    def news(self) -> list[str]:
        """Return lines for the operator since the last call."""

    def close(self) -> None:
        """Release what the host holds, after its places."""
