"""Supervision: who starts workers, starts those again that die, and says how each of them ended.

The loop (:mod:`v2v_server.serve`) knows only the :class:`Supervisor`. Of this host's processes it is the
:class:`v2v_server.supervise.local_pool.Pool`, of a cluster's :class:`v2v_server.supervise.ray_workers.RayWorkers`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from v2v_server.broker.blame import Loss
from v2v_server.broker.leases import Stall


@dataclass(frozen=True, slots=True)
class Death:
    """A worker that ended without being asked to, or that could not be started.

    Attributes:
        identity: the worker's name, as it says hello.
        loss: what its end says about the sample it was at.
    """

    identity: bytes
    loss: Loss


class Supervisor(Protocol):
    """Keeps a number of workers running. No method waits for a worker, except ``stop``."""

    @property
    def running(self) -> int:
        """Workers that are alive."""

    @property
    def restarts(self) -> Mapping[bytes, int]:
        """Of each worker that is its, how often its place was filled before, because the process in it had ended."""

    def start(self, address: str) -> None:
        """From now on workers may be started; they connect to ``address``."""

    def scale(self, workers: int) -> None:
        """There shall be so many. Those that are too many finish what they are at and leave."""

    def watch(self, now: float, samples: int) -> list[Death]:
        """Who has died since the last call; starts what is due. Called a few times a second.

        Args:
            now: the time, seconds.
            samples: samples finished so far by all workers; any progress forgives earlier deaths.

        Raises:
            WorkerCrashLoop: the workers die again and again without finishing anything.
        """

    def stalled(self, now: float) -> dict[bytes, Stall]:
        """Workers that were kept from working since the last call, and how long: no deadline runs meanwhile."""

    def watches(self, identity: bytes) -> bool:
        """Whether :meth:`watch` will say how that worker ends."""

    def give_up(self, identity: bytes, reason: str) -> Loss | None:
        """Ends a worker that hangs.

        Returns:
            what its loss means, not to be reported again by :meth:`watch`; None when it is none of this supervisor's.
        """

    def news(self) -> list[str]:
        """Lines for the operator since the last call: where workers are placed, say."""

    def stop(self) -> None:
        """Ends every worker. They have been told to stop; whoever does not is made to."""
