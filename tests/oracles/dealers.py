"""Many peers of a server in one process, over one ZeroMQ context and its thread."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress

import zmq

from v2v_protocol.keys import PeerKey, key_for
from v2v_protocol.link.dealer import Dealer, secure
from v2v_protocol.messages import Frames

_TINY: Mapping[int, int] = {zmq.RCVHWM: 1, zmq.SNDHWM: 1000, zmq.SNDTIMEO: 2000, zmq.LINGER: 0}


class NextDealer(Dealer):
    """A dealer that shares the context of another one, which must be closed later.

    Args:
        first: that one.
        address, keys, side: as of :class:`Dealer`.
    """

    def __init__(self, first: Dealer, address: str, keys: str | PeerKey | None = None, side: str = "consumer") -> None:
        super().__init__(address, keys, side, insecure=True)
        self._context.destroy()
        self._context = first._context
        self._questions = self._context.socket(zmq.ROUTER)  # where no question ever arrives

    def close(self) -> None:
        """Close the sockets, and leave the context."""
        self.disconnect(linger_ms=0)
        self._questions.close()


class Reader:
    """A consumer that takes one message at a time, and waits when it cannot send.

    Args:
        first: whose context it shares.
        address: of the server.
        name: routing id.
    """

    def __init__(self, first: Dealer, address: str, name: bytes) -> None:
        self._socket = first._context.socket(zmq.DEALER)
        self._socket.setsockopt(zmq.ROUTING_ID, name)
        for option, value in _TINY.items():
            self._socket.setsockopt(option, value)
        if (key := key_for(address, "consumer", None)) is not None:
            secure(self._socket, key)
        self._socket.connect(address)

    def send(self, frames: Frames) -> None:
        """Send a message; drop it if there is no room for it in time."""
        with suppress(zmq.Again):
            self._socket.send_multipart(frames)

    def receive(self, seconds: float) -> None:
        """Take one message, if one comes in time."""
        if self._socket.poll(math.ceil(1000 * seconds)):
            self._socket.recv_multipart()

    def close(self) -> None:
        """Disconnect."""
        self._socket.close()


def wait(dealers: Sequence[Dealer], seconds: float) -> list[Dealer]:
    """Wait until one of several dealers has a message; return those that have one."""
    poller = zmq.Poller()
    by_socket = {dealer._open(dealer._socket): dealer for dealer in dealers}
    for each in by_socket:
        poller.register(each, zmq.POLLIN)
    return [by_socket[ready] for ready, _ in poller.poll(math.ceil(seconds * 1000))]
