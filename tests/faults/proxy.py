"""A TCP proxy on loopback that breaks the network on request.

Every fault can be told after how many bytes to strike and how many connections to hurt, so that it strikes in the
middle of a message and heals by itself at a known point: no test has to guess how long to wait.
"""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum, auto

_CHUNK_BYTES = 1 << 14
_ALWAYS = 1 << 62


class Way(Enum):
    """Which bytes a fault counts."""

    TO_CLIENT = auto()
    TO_SERVER = auto()


class _Fault(Enum):
    TRUNCATE = auto()
    BLACKHOLE = auto()


@dataclass(slots=True, eq=False)
class _Connection:
    client: socket.socket
    server: socket.socket
    passed: dict[Way, int] = field(default_factory=lambda: dict.fromkeys(Way, 0))
    swallows: bool = False

    def shut(self) -> None:
        """Wakes both pumps and tells both peers."""
        for end in (self.client, self.server):
            try:
                end.shutdown(socket.SHUT_RDWR)
            except OSError:  # that peer had left already
                continue


class Proxy:
    """Passes bytes between the clients of :attr:`address` and a server, from ``with`` on.

    Args:
        target: ``tcp://host:port`` of the server.

    Attributes:
        address: where clients connect to.
        connections: accepted so far.
        refused: of those, closed at once.
        truncated: of those, closed in mid-stream.
        swallowed: bytes that vanished.
    """

    def __init__(self, target: str) -> None:
        host, _, port = target.removeprefix("tcp://").rpartition(":")
        self._target = (host, int(port))
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"tcp://127.0.0.1:{self._listener.getsockname()[1]}"
        self.connections = self.refused = self.truncated = self.swallowed = 0
        self._change = threading.Condition()
        self._open: set[_Connection] = set()
        self._threads: list[threading.Thread] = []
        self._closed = threading.Event()
        self._healthy()

    def _healthy(self) -> None:
        self._delay_seconds = 0.0
        self._refusals = 0
        self._fault: _Fault | None = None
        self._way, self._after_bytes, self._victims = Way.TO_CLIENT, 0, 0

    def __enter__(self) -> Proxy:
        self._spawn(self._accept)
        return self

    def __exit__(self, *_: object) -> None:
        self._closed.set()
        self._listener.shutdown(socket.SHUT_RDWR)
        self.cut()
        for thread in self._threads:
            thread.join()
        self._listener.close()

    # --- faults -------------------------------------------------------------------------------------------------------

    def cut(self) -> None:
        """Closes every connection; new ones pass."""
        with self._change:
            for connection in self._open:
                connection.shut()

    def refuse(self, connections: int = _ALWAYS) -> None:
        """Closes the next so many connections as soon as they are made."""
        with self._change:
            self._refusals = connections

    def delay(self, seconds: float) -> None:
        """Holds up every piece of up to 16 KiB."""
        with self._change:
            self._delay_seconds = seconds

    def truncate(self, after_bytes: int, *, way: Way = Way.TO_CLIENT, connections: int = 1) -> None:
        """Closes a connection as soon as it has passed so many bytes from now on (a new one: from its beginning); so
        many connections one after the other."""
        self._begin(_Fault.TRUNCATE, after_bytes, way, connections)

    def blackhole(self, after_bytes: int = 0, *, way: Way = Way.TO_CLIENT, connections: int = _ALWAYS) -> None:
        """Lets everything vanish, in both directions, on so many connections, each once it has passed so many bytes.

        As behind a firewall that forgot a connection: it stays open and dead, whatever heals later.
        """
        self._begin(_Fault.BLACKHOLE, after_bytes, way, connections)

    def _begin(self, fault: _Fault, after_bytes: int, way: Way, connections: int) -> None:
        with self._change:
            self._fault, self._after_bytes, self._way, self._victims = fault, after_bytes, way, connections
            for connection in self._open:
                connection.passed = dict.fromkeys(Way, 0)

    def heal(self) -> None:
        """From now on everything passes, except on connections that were swallowed."""
        with self._change:
            self._healthy()

    # --- threads ------------------------------------------------------------------------------------------------------

    def _spawn(self, work: Callable[..., None], *arguments: object) -> None:
        thread = threading.Thread(target=work, args=arguments, daemon=True)
        self._threads.append(thread)
        thread.start()

    def _accept(self) -> None:
        while not self._closed.is_set():
            try:
                client, _ = self._listener.accept()
            except OSError:  # closed
                return
            with self._change:
                self.connections += 1
                refuse = self._refusals > 0
                self._refusals -= refuse
                self.refused += refuse
                self._change.notify_all()
            if refuse:
                client.close()
                continue
            try:
                server = socket.create_connection(self._target)
            except OSError:  # the server is gone: so is the proxy
                client.close()
                continue
            connection = _Connection(client, server)
            with self._change:
                self._open.add(connection)
            self._spawn(self._serve, connection)

    def _serve(self, connection: _Connection) -> None:
        """Both directions of a connection, until either end closes it."""
        up = threading.Thread(target=self._pump, args=(connection, connection.client, connection.server, Way.TO_SERVER))
        up.start()
        self._pump(connection, connection.server, connection.client, Way.TO_CLIENT)
        up.join()
        with self._change:
            self._open.discard(connection)
        connection.client.close()
        connection.server.close()

    def _pump(self, connection: _Connection, source: socket.socket, sink: socket.socket, way: Way) -> None:
        try:
            while content := source.recv(_CHUNK_BYTES):
                if self._delay_seconds:
                    self._closed.wait(self._delay_seconds)
                passing, ends = self._judge(connection, len(content), way)
                sink.sendall(content[:passing])
                if ends:
                    break
        except OSError:  # one of the ends is gone
            pass
        finally:
            connection.shut()

    def _judge(self, connection: _Connection, size: int, way: Way) -> tuple[int, bool]:
        """How many of the next bytes pass, and whether the connection ends behind them."""
        with self._change:
            passing, ends = size, False
            if not connection.swallows and self._fault is not None and self._way is way and self._victims:
                passing = min(size, max(0, self._after_bytes - connection.passed[way]))
                if passing < size or connection.passed[way] + passing >= self._after_bytes:
                    self._victims -= 1
                    ends = self._fault is _Fault.TRUNCATE
                    self.truncated += ends
                    connection.swallows = not ends
                    self.swallowed += size - passing
            elif connection.swallows:
                passing = 0
                self.swallowed += size
            connection.passed[way] += passing
            self._change.notify_all()
            return passing, ends
