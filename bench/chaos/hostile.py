"""Eight hostile peers of one kind, as a process that runs until SIGTERM.

    python -m bench.chaos.hostile --address tcp://127.0.0.1:5555 --kind headers

    headers    the largest and most expensive header that is allowed, as fast as possible
    hello      sends Hello ten times a second, requests as much as allowed, and never reads
    deaf       sends Hello once, requests the same samples again and again, and never reads
    leave      sends Hello under a new name and disconnects, repeatedly: its sessions stay
    look       requests the state of the service without a pause, and never reads
    idle       opens connections, half of them in the middle of the handshake, and sends nothing
    flood      bytes that are not ZMTP, as fast as possible
    trickle    opens connections and sends a handshake on each, one byte at a time, without the end
    refused    only with keys: connects with an unknown key, with a revoked one, and with a consumer's key to the port
               of the workers, again and again
    handshakes only with keys: sends the recorded first message of a handshake over new connections: cheap for the
               sender, expensive for the server

If `V2V_KEYS` names a consumer's key they use it. A disconnected peer reconnects. Nothing is checked here: the effect on
other peers counts.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import os
import select
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

from tests.oracles.dealers import NextDealer, Reader
from v2v_protocol.errors import KeyRefused, V2VError
from v2v_protocol.keys import VARIABLE as KEY_VARIABLE
from v2v_protocol.keys import PeerKey, key_for, read_key
from v2v_protocol.link.dealer import Dealer
from v2v_protocol.link.router import new_key_pair
from v2v_protocol.messages import LARGEST_REQUEST_BYTES, MOST_CONTAINERS, GetStatus, Hello, Want, encode

PEERS = 8
IDLE_EACH = 125  # Connections of each idle peer: a thousand of all eight
_GREETING = b"\xff\0\0\0\0\0\0\0\0\x7f\x03\0%s" + bytes(1 + 31)
SPEC = {"recipe": {"preset": "paper", "voxels_per_clip": 4, "crop_height_px": 32, "crop_width_px": 40}}
_REFUSAL_SECONDS = 2.0
TALLY = "V2V_CHAOS_TALLY"
_GREETING_BYTES, _HELLO_BYTES, _WELCOME_BYTES = 64, 202, 170  # with their framing


def headers(address: str, number: int) -> None:
    """Act as a peer of this kind until it is disconnected; likewise the functions below."""
    items = LARGEST_REQUEST_BYTES - 5
    costly = b"\xdd" + items.to_bytes(4, "big") + b"\x90" * MOST_CONTAINERS + bytes(items - MOST_CONTAINERS)
    with _reader(address) as peer:
        for _ in range(64):  # the server disconnects such a peer
            peer.send([costly])


def hello(address: str, number: int) -> None:
    """See the module."""
    with _reader(address) as peer:
        for epoch in itertools.count():
            peer.send(encode(Hello(SPEC, ("voxels", "frames"), 2000, number)))
            peer.send(encode(Want(epoch, tuple(range(256)))))
            time.sleep(0.1)


def deaf(address: str, number: int) -> None:
    """See the module."""
    with _reader(address) as peer:
        peer.send(encode(Hello(SPEC, ("voxels", "frames"), 32, 0)))
        while True:
            peer.send(encode(Want(0, tuple(range(32)))))
            time.sleep(0.001)


def leave(address: str, number: int) -> None:
    """See the module."""
    with _reader(address) as peer:
        peer.send(encode(Hello(SPEC, ("voxels",), 8, number)))
        peer.receive(1.0)


def look(address: str, number: int) -> None:
    """See the module."""
    with _reader(address) as peer:
        while True:
            peer.send(encode(GetStatus()))


def idle(address: str, number: int) -> None:
    """See the module."""
    with ExitStack() as stack:
        for count in range(IDLE_EACH):
            link = stack.enter_context(_connected(address))
            if count % 2:
                link.sendall(_greeting(address))
        time.sleep(2.0)


def flood(address: str, number: int) -> None:
    """See the module."""
    with _connected(address) as peer:
        while True:
            _push(peer, os.urandom(1 << 16))


def trickle(address: str, number: int) -> None:
    """See the module."""
    with ExitStack() as stack:
        links = [stack.enter_context(_connected(address)) for _ in range(IDLE_EACH)]
        for byte in _greeting(address)[:-1]:
            for link in links:
                with suppress(OSError):  # it was disconnected
                    link.send(bytes([byte]))
            time.sleep(0.1)


def refused(worker_address: str, revoked: Path, address: str, number: int) -> None:
    """See the module; ``revoked`` is the file of a revoked key."""
    known = read_key(Path(os.environ[KEY_VARIABLE]))
    public, secret = new_key_pair()
    unknown = replace(known, public=public, secret=secret)
    for key, where in ((unknown, address), (read_key(revoked), address), (known, worker_address)):
        if _is_refused(where, key):
            _count()


def _is_refused(address: str, key: PeerKey) -> bool:
    with _closing(NextDealer(_first(), address, key)) as peer:
        deadline = time.monotonic() + _REFUSAL_SECONDS
        while (left := deadline - time.monotonic()) > 0:
            peer.receive(left)
            try:
                peer.has_reconnected()
            except KeyRefused:
                return True
    return False


@functools.cache
def recorded_handshake() -> bytes:
    """Return what a peer with the key of ``V2V_KEYS`` sends to a server that only listens: greeting, first message."""
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        _closing(NextDealer(_first(), f"tcp://127.0.0.1:{server.getsockname()[1]}")),
        server.accept()[0] as link,
    ):
        link.sendall(_GREETING % b"CURVE".ljust(20, b"\0"))
        said = b""
        while len(said) < _GREETING_BYTES + _HELLO_BYTES:
            said += link.recv(4096)
    return said


def handshakes(address: str, number: int) -> None:
    """See the module."""
    while True:
        with _connected(address) as peer:
            peer.sendall(recorded_handshake())
            answer = b""
            while len(answer) < _GREETING_BYTES + _WELCOME_BYTES and (piece := peer.recv(4096)):
                answer += piece


KINDS: dict[str, Callable[[str, int], None]] = {
    each.__name__: each for each in (headers, hello, deaf, leave, look, idle, flood, trickle)
}
REFUSED, HANDSHAKES = "refused", "handshakes"
KEYED_KINDS = (REFUSED, HANDSHAKES)


def attack(address: str, act: Callable[[str, int], None]) -> NoReturn:
    """Run :data:`PEERS` peers, which reconnect when disconnected, until this process ends."""

    def live(number: int) -> NoReturn:
        while True:
            with suppress(OSError, V2VError):  # disconnected, or the server restarts
                act(address, number)
            time.sleep(0.01)

    for number in range(1, PEERS):
        threading.Thread(target=live, args=(number,), daemon=True).start()
    live(0)


def _greeting(address: str) -> bytes:
    """Return the 64 bytes of a ZMTP greeting: with CURVE if there is a key for that address, else NULL."""
    return _GREETING % (b"CURVE" if address and key_for(address, "consumer", None) else b"NULL").ljust(20, b"\0")


def _connected(address: str) -> socket.socket:
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    link = socket.create_connection((host, int(port)), 5.0)
    _count()
    return link


def _push(peer: socket.socket, data: bytes) -> None:
    """Send data, and notice at once if the server ends the connection, which ``sendall`` does not.

    Raises:
        ConnectionError: the server has ended the connection.
    """
    left = memoryview(data)
    while left:
        readable, writable, _ = select.select([peer], [peer], [])
        if readable and not peer.recv(1 << 16):
            raise ConnectionResetError
        if writable:
            left = left[peer.send(left) :]


def _count() -> None:
    """Count a connection, or a refused handshake."""
    with open(os.environ.get(TALLY, os.devnull), "ab") as file:
        file.write(b".")


@functools.cache
def _first() -> Dealer:
    """Return the dealer whose context and thread all others share."""
    return Dealer("", "")


@contextmanager
def _closing(peer: Dealer) -> Iterator[Dealer]:
    """Connect a peer; close it at the end of the block."""
    try:
        peer.connect()
        yield peer
    finally:
        peer.close()


def _reader(address: str) -> AbstractContextManager[Reader]:
    """Connect a peer under a new routing id, as every peer of ours does.

    libzmq 4.3.5 never frees the unread messages of a connection whose routing id another connection has.
    """
    return closing(Reader(_first(), address, b"hostile-" + os.urandom(8)))


def main() -> NoReturn:
    """Run the peers."""
    parser = argparse.ArgumentParser(prog="python -m bench.chaos.hostile", description=__doc__)
    parser.add_argument("--address", required=True)
    parser.add_argument("--kind", required=True, choices=(*KINDS, *KEYED_KINDS))
    parser.add_argument("--worker-address", help="for refused: the port of the workers")
    parser.add_argument("--revoked", type=Path, help="for refused: a revoked key")
    asked = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(0))
    keyed: dict[str, Callable[[str, int], None]] = {
        REFUSED: functools.partial(refused, asked.worker_address, asked.revoked), HANDSHAKES: handshakes,
    }  # fmt: skip
    attack(asked.address, (KINDS | keyed)[asked.kind])


if __name__ == "__main__":
    main()
