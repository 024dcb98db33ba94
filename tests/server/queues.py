"""A server without sockets and processes: peers talk over plain queues, and a toy pool keeps the workers."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from v2v_protocol.link.router import FromConsumer, FromWorker, ServerInput
from v2v_protocol.messages import Message, decode, encode
from v2v_server.broker.leases import Cause, Loss, Stall
from v2v_server.supervise.pool import Death


@dataclass
class Queues:
    """A transport of plain queues.

    Attributes:
        arrived: what peers have sent and the server has not taken yet, oldest first.
        sent: what the server has sent to each peer that is there, and that has not taken it yet.
    """

    address: str = "queue://consumers"
    worker_address: str = "queue://workers"
    waited_seconds: float = 0.0
    arrived: deque[ServerInput] = field(default_factory=deque)
    sent: dict[bytes, deque[Sequence[Any]]] = field(default_factory=dict)

    def receive(self, seconds: float) -> list[ServerInput]:
        return [self.arrived.popleft()] if self.arrived else []

    def send(self, identity: bytes, frames: Sequence[Any], *, to_worker: bool = False) -> bool:
        there = self.sent.get(identity)
        if there is None:
            return False
        there.append(frames)
        return True

    def cut(self, identity: bytes) -> None:
        self.sent.pop(identity, None)

    def close(self) -> None:
        self.sent.clear()

    # What peers do.

    def connect(self, identity: bytes) -> None:
        self.sent[identity] = deque()

    def consumer_says(self, identity: bytes, message: Message) -> None:
        self.arrived.append(FromConsumer(identity, encode(message)))

    def worker_says(self, identity: bytes, frames: Sequence[Any]) -> None:
        self.arrived.append(FromWorker(identity, frames))

    def take(self, identity: bytes) -> list[Message]:
        """The messages that were sent to that peer since the last call."""
        taken = [decode(frames[0]) for frames in self.sent[identity]]
        self.sent[identity].clear()
        return taken


class ToyPool:
    """Keeps as many workers as it was told to, each of which is whatever ``begin`` makes of a name and an address.

    Args:
        begin: starts a worker.
    """

    is_local = True

    def __init__(self, begin: Callable[[bytes, str], None]) -> None:
        self._begin = begin
        self._address = ""
        self._named = 0
        self.workers: list[bytes] = []
        self.wanted = 0
        self.deaths: list[Death] = []

    @property
    def running(self) -> int:
        return len(self.workers)

    @property
    def restarts(self) -> dict[bytes, int]:
        return dict.fromkeys(self.workers, 0)

    def start(self, address: str) -> None:
        self._address = address

    def scale(self, workers: int) -> None:
        self.wanted = workers
        del self.workers[workers:]

    def watch(self, now: float, samples: int) -> list[Death]:
        deaths, self.deaths = self.deaths, []
        while len(self.workers) < self.wanted:
            self._named += 1
            self.workers.append(f"toy{self._named}".encode())
            self._begin(self.workers[-1], self._address)
        return deaths

    def stalled(self, now: float) -> dict[bytes, Stall]:
        return {}

    def watches(self, identity: bytes) -> bool:
        return identity in self.workers

    def give_up(self, identity: bytes, reason: str) -> Loss | None:
        if identity not in self.workers:
            return None
        self.workers.remove(identity)
        return Loss(Cause.HUNG, reason)

    def news(self) -> list[str]:
        return []

    def stop(self) -> None:
        self.scale(0)

    def kill(self, identity: bytes, cause: Cause) -> None:
        """That worker ends."""
        self.workers.remove(identity)
        self.deaths.append(Death(identity, Loss(cause, "died")))
