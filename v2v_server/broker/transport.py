"""Send and receive messages of consumers and workers.

The loop (:mod:`v2v_server.serve`) uses only the :class:`ServerTransport` protocol. The server implements it with
:class:`Sockets` (:mod:`v2v_protocol.link`); tests implement it with plain queues.

Samples pass through in the frames that arrived; only the small header before them is read.

Memory: what a consumer has not read counts against its credit and its share of MOST_IN_FLIGHT_BYTES
(:mod:`v2v_server.broker.session`). A peer that asks and never reads is disconnected at ``router.MOST_QUEUED`` messages,
which is above any credit, or after some time if there are too many bytes in all (:mod:`v2v_protocol.link.router`).
Workers add at most 2 samples each.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypeAlias

from v2v_protocol.link.curve import KeyStore
from v2v_protocol.link.router import Received, Routers
from v2v_protocol.messages import LARGEST_ARRAY_BYTES, LARGEST_REQUEST_BYTES
from v2v_server.broker.actions import ToConsumer, ToWorker
from v2v_server.system.process import MOST_CONNECTIONS


class FromConsumer(Received):
    """A message that a consumer sent."""


class FromWorker(Received):
    """A message that a worker sent."""


@dataclass(frozen=True, slots=True)
class ConsumerGone:
    """The connection of a consumer has ended; the consumer may come back over another one.

    Attributes:
        identity: routing id; empty for connections that never sent a message.
    """

    identity: bytes


@dataclass(frozen=True, slots=True)
class InFlight:
    """How much of what was sent to a consumer has not left this process yet, after a change.

    Attributes:
        identity: routing id of its connection.
        nbytes: bytes, without small messages.
    """

    identity: bytes
    nbytes: int


BrokerInput: TypeAlias = FromConsumer | FromWorker | ConsumerGone | InFlight


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

    def receive(self, seconds: float) -> list[BrokerInput]:
        """Return at most one message of each side, the workers' first, so that neither side can starve the other.
        Changes of what is in flight come first, ended connections last.

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
        keys: keys of the peers that may connect over ``tcp://``; None admits all peers.
        local_bind: address for workers of this host, which have no key; used if ``worker_bind`` is for other hosts.
        admits: returns whether a connection that was just accepted may stay; None admits all.

    Attributes:
        has_session: returns whether a peer's connection is kept when another needs its place; called by another thread.

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
        keys: KeyStore | None = None,
        local_bind: str = "",
        admits: Callable[[socket.socket], bool] | None = None,
    ) -> None:
        self.waited_seconds = 0.0
        self.has_session: Callable[[bytes], bool] = lambda identity: False
        self._routers = Routers(keys)
        try:
            # The attribute is read at each call, because it is set later.
            self._consumers = self._routers.open(
                "consumer", LARGEST_REQUEST_BYTES, most_connections, lambda peer: self.has_session(peer), admits
            )
            is_private = worker_bind.startswith("ipc:")
            most = None if is_private else most_connections
            self._workers = self._routers.open(
                "worker", LARGEST_ARRAY_BYTES, most, lambda peer: self.has_session(peer), admits
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

    def receive(self, seconds: float) -> list[BrokerInput]:
        """Implement :meth:`ServerTransport.receive`."""
        began = time.monotonic()
        ready = self._routers.wait(seconds)
        self.waited_seconds += time.monotonic() - began
        arrivals: list[BrokerInput] = [InFlight(*each) for each in self._consumers.take_in_flight().items()]
        if self._workers in ready and (sample := self._workers.receive(FromWorker)) is not None:
            arrivals.append(sample)
        if self._consumers in ready and (request := self._consumers.receive(FromConsumer)) is not None:
            arrivals.append(request)
        arrivals += map(ConsumerGone, self._consumers.take_ended())
        self._workers.take_in_flight()
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
