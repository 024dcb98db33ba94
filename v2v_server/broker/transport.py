"""Send and receive messages of consumers and workers.

The loop (:mod:`v2v_server.serve`) uses only the :class:`ServerTransport` protocol. The server implements it with
:class:`Sockets` (:mod:`v2v_protocol.link`); tests implement it with plain queues.

Samples pass through in the frames that arrived; only the small header before them is read.

Memory: a consumer asks for more only after it has taken what it was sent. So the broker holds at most the sum over all
sessions of credit x sample bytes (in ZeroMQ's send queue of a slow consumer) + workers x 2 x sample bytes. A peer that
asks and never reads is disconnected at ``router.MOST_QUEUED`` messages, which is above any credit, or at the bytes of
its credit (:mod:`v2v_protocol.link.guard`).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

from v2v_protocol.link.curve import KeyStore
from v2v_protocol.link.guard import MOST_CONNECTIONS
from v2v_protocol.link.router import Limits, Routers
from v2v_protocol.wire import LARGEST_ARRAY_BYTES, LARGEST_REQUEST_BYTES
from v2v_server.broker.actions import ToConsumer, ToWorker


@dataclass(frozen=True, slots=True)
class FromConsumer:
    """A message that a consumer sent.

    Attributes:
        identity: routing id of its connection.
        frames: the message.
        user: name of the key of its connection; empty without keys.
    """

    identity: bytes
    frames: Sequence[Any]
    user: str = ""


@dataclass(frozen=True, slots=True)
class FromWorker:
    """A message that a worker sent.

    Attributes:
        identity: routing id of its connection.
        frames: the message.
        user: name of the key of its connection; empty without keys, and for a worker of this host.
    """

    identity: bytes
    frames: Sequence[Any]
    user: str = ""


@dataclass(frozen=True, slots=True)
class ConsumerGone:
    """The connection of a consumer has ended; the consumer may come back over another one.

    Attributes:
        identity: routing id; empty for connections that never sent a message.
    """

    identity: bytes


Arrival: TypeAlias = FromConsumer | FromWorker | ConsumerGone


class ServerTransport(Protocol):
    """Transport of messages between the server and its peers."""

    @property
    def address(self) -> str:
        """Where consumers connect."""

    @property
    def worker_address(self) -> str:
        """Where workers connect."""

    @property
    def waited_seconds(self) -> float:
        """Total time that :meth:`receive` has waited without a message, seconds."""

    def receive(self, seconds: float) -> list[Arrival]:
        """Return at most one message of each side, the workers' first, so that neither side can starve the other. Ended
        connections follow last.

        Args:
            seconds: longest wait for any of them.
        """

    def send(self, action: ToConsumer | ToWorker) -> bool:
        """Send a message; return False if the peer is not connected any more or does not read."""

    def cut(self, identity: bytes) -> None:
        """End the connection of a consumer."""

    def close(self) -> None:
        """End all connections; unsent messages are dropped."""


class Sockets:
    """Two routers, one for consumers and one for workers.

    Args:
        bind: address for consumers.
        worker_bind: address for workers.
        most_connections: largest number of consumer connections at a time, and of worker connections.
        most_queued_bytes: largest number of bytes queued for one consumer.
        keys: keys of the peers that may connect over ``tcp://``; None admits all peers.
        local_bind: address for workers of this host, which have no key; used if ``worker_bind`` is for other hosts.

    Raises:
        UsageError: an address cannot be bound; the message names the flag.
        KeyRefused: the server's own keys cannot be read.
    """

    def __init__(
        self,
        bind: str,
        worker_bind: str,
        *,
        most_connections: int = MOST_CONNECTIONS,
        most_queued_bytes: int = 1 << 40,
        keys: KeyStore | None = None,
        local_bind: str = "",
    ) -> None:
        self.waited_seconds = 0.0
        self._routers = Routers(keys)
        try:
            self._consumers = self._routers.open(
                "consumer", Limits(LARGEST_REQUEST_BYTES, most_connections, most_queued_bytes)
            )
            # Workers send large samples, so only the number of their connections is limited.
            is_private = worker_bind.startswith("ipc:")
            self._workers = self._routers.open(
                "worker", Limits(LARGEST_ARRAY_BYTES, None if is_private else most_connections)
            )
            self.address = self._consumers.bind(bind, "--bind")
            local = ""
            if local_bind and not is_private:
                local = self._workers.bind(local_bind, "--worker-bind", admits_all=True)
            self.worker_address = self._workers.bind(worker_bind, "--worker-bind")
            self.local_address = local or self.worker_address
        except BaseException:
            self.close()
            raise

    def receive(self, seconds: float) -> list[Arrival]:
        """Implement :meth:`ServerTransport.receive`."""
        began = time.monotonic()
        ready = self._routers.wait(seconds)
        self.waited_seconds += time.monotonic() - began
        arrivals: list[Arrival] = []
        if self._workers in ready and (message := self._workers.receive()) is not None:
            arrivals.append(FromWorker(message.identity, message.frames, message.user))
        if self._consumers in ready and (message := self._consumers.receive()) is not None:
            arrivals.append(FromConsumer(message.identity, message.frames, message.user))
        arrivals += map(ConsumerGone, self._consumers.take_ended())
        self._workers.take_ended()
        return arrivals

    def send(self, action: ToConsumer | ToWorker) -> bool:
        """Implement :meth:`ServerTransport.send`."""
        router = self._consumers if isinstance(action, ToConsumer) else self._workers
        return router.send(action.identity, action.frames)

    def cut(self, identity: bytes) -> None:
        """Implement :meth:`ServerTransport.cut`."""
        self._consumers.disconnect(identity)

    def close(self) -> None:
        """Close both sockets; unsent messages are dropped."""
        self._routers.close()
