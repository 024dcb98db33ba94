"""Eight hostile consumers of one kind, as a process: until SIGTERM.

    python -m bench.chaos.hostile --address tcp://127.0.0.1:5555 --kind parts

    parts      raw peers whose messages have no end: one part after the other, each with MORE behind it
    headers    the largest and most costly header that is let in, as fast as it is taken
    hello      says Hello ten times a second, asks for as much as it may, and never reads
    leave      says Hello under a new name and goes, again and again: its sessions stay behind
    thief      takes the ids that the status shows for routing ids, and says Hello and Goodbye under each of them
    look       asks for the state of the service without a pause, and never reads
    idle       takes connections, half of them in the middle of the handshake, and says nothing
    flood      bytes that are no ZeroMQ's, as fast as they are taken
    trickle    takes connections and says a handshake on each, a byte at a time, without ever ending it
    slow       no enemy: a stream that is allowed and takes long (flow on whole pictures, long clips)
    refused    only with keys: comes with a key that nobody knows, with a revoked one, and with a consumer's to the port
               of the workers, and begins anew as soon as it is turned away
    handshakes only with keys: the first message of a handshake, recorded once and sent again and again, each time over
               a new connection: it costs its sender nothing, and the server its arithmetic

They come from 127.0.0.2 to a server at 127.0.0.1, so that what it holds against hosts strikes them and not others.
Where `V2V_KEYS` names a consumer's key, they come with it; only `parts` speaks plainly, and some do not get so far.
Whoever is cut off connects again. Nothing is checked here: what counts is what happens to others.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NoReturn

import zmq

from v2v_protocol.keys import VARIABLE as KEY_VARIABLE
from v2v_protocol.keys import key_for, read_key
from v2v_protocol.messages import Goodbye, Hello, See, Seen, Want
from v2v_protocol.spec import SpecOptions
from v2v_protocol.wire import LARGEST_REQUEST_BYTES, MOST_CONTAINERS, decode, encode

PEERS = 8
IDLE_EACH = 125
"""Connections of each idle peer: a thousand in all."""
_GREETING = b"\xff\0\0\0\0\0\0\0\0\x7f\x03\0%s" + bytes(1 + 31)
_READY = b"\x04\x19\x05READY\x0bSocket-Type\0\0\0\x06DEALER"
_PART = b"\x01\xff" + bytes(255)
SPEC = {"recipe": {"preset": "paper", "voxels_per_clip": 4, "crop_height_px": 32, "crop_width_px": 40}}
_TURNED_AWAY_MS = 2000
_ELSEWHERE = "127.0.0.2"
_tally: Path | None = None
_GREETING_BYTES, _HELLO_BYTES, _WELCOME_BYTES = 64, 202, 170  # with the bytes that frame them
SLOW_RECIPE = "paper-flow"
SLOW_SPEC: SpecOptions = {"flow_method": "dis-fast-1", "flow_margin_px": -1}


def parts(address: str, number: int) -> None:
    """One life of a peer of this kind; the others likewise."""
    with _raw(address) as peer:
        while True:
            peer.sendall(_PART * 256)


def headers(address: str, number: int) -> None:
    """See the module."""
    items = LARGEST_REQUEST_BYTES - 5
    costly = b"\xdd" + items.to_bytes(4, "big") + b"\x90" * MOST_CONTAINERS + bytes(items - MOST_CONTAINERS)
    with _dealer(address, number) as peer:
        for _ in range(64):  # the server cuts off whoever goes on like this
            peer.send(costly)


def hello(address: str, number: int) -> None:
    """See the module."""
    with _dealer(address, number) as peer:
        for epoch in itertools.count():
            peer.send_multipart(encode(Hello(SPEC, ("voxels", "frames"), 2000, number)))
            peer.send_multipart(encode(Want(epoch, tuple(range(256)))))
            time.sleep(0.1)


def leave(address: str, number: int) -> None:
    """See the module."""
    with _dealer(address, None) as peer:
        peer.send_multipart(encode(Hello(SPEC, ("voxels",), 8, number)))
        peer.poll(1000)


def thief(address: str, number: int) -> None:
    """See the module."""
    with _dealer(address, number) as peer:
        peer.send_multipart(encode(See()))
        if not peer.poll(_TURNED_AWAY_MS):
            return
        seen = decode(peer.recv_multipart()[0])
    shown = json.loads(seen.json)["consumers"] if isinstance(seen, Seen) else []
    for each in shown:
        for name in (each["id"].encode(), bytes.fromhex(each["id"])):
            with _dealer(address, name) as peer:
                peer.send_multipart(encode(Goodbye()))
                peer.send_multipart(encode(Hello(SPEC, ("voxels",), 8, number)))
                peer.poll(100)


def look(address: str, number: int) -> None:
    """See the module."""
    with _dealer(address, number) as peer:
        while True:
            peer.send_multipart(encode(See()))


def idle(address: str, number: int) -> None:
    """See the module."""
    links = []
    try:
        for count in range(IDLE_EACH):
            links.append(_connected(address))
            if count % 2:
                links[-1].sendall(_greeting(address))
        time.sleep(2.0)
    finally:
        for link in links:
            link.close()


def flood(address: str, number: int) -> None:
    """See the module."""
    with _connected(address) as peer:
        while True:
            peer.sendall(os.urandom(1 << 16))


def trickle(address: str, number: int) -> None:
    """See the module."""
    said = _greeting(address)
    links: list[socket.socket] = []
    try:
        for _ in range(IDLE_EACH):
            links.append(_connected(address))
        for byte in said[:-1]:
            for link in links:
                with suppress(OSError):  # that one was cut off
                    link.send(bytes([byte]))
            time.sleep(0.1)
    finally:
        for link in links:
            link.close()


def slow(address: str, number: int) -> None:
    """See the module."""
    from v2v_client.dataset import V2VStreamDataset  # PyTorch, which the others do not need

    arrays = ("voxels", "flow", "flow_valid")
    dataset = V2VStreamDataset(address, 1, arrays, SLOW_RECIPE, seed=number, rank=0, world_size=1, **SLOW_SPEC)
    for _ in dataset:
        pass


@dataclass(frozen=True, slots=True)
class Refused:
    """See the module.

    Args:
        worker_address: the other port.
        revoked: file of a revoked consumer's key.
    """

    worker_address: str
    revoked: Path

    def __call__(self, address: str, number: int) -> None:
        known, revoked = read_key(Path(os.environ[KEY_VARIABLE])), read_key(self.revoked)
        public, secret = (half.decode() for half in zmq.curve_keypair())
        unknown = replace(known, public=public, secret=secret)
        for key, where in ((unknown, address), (revoked, address), (known, self.worker_address)):
            peer: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.DEALER)
            monitor = peer.get_monitor_socket(zmq.EVENT_HANDSHAKE_FAILED_AUTH)
            try:
                peer.setsockopt(zmq.LINGER, 0)
                key.secure(peer)
                peer.connect(_from_elsewhere(where))
                if monitor.poll(_TURNED_AWAY_MS):
                    _count()
            finally:
                peer.disable_monitor()
                peer.close()


@dataclass(frozen=True, slots=True)
class Handshakes:
    """See the module.

    Args:
        said: greeting and first message of somebody with a key of that server's.
    """

    said: bytes

    @classmethod
    def recorded(cls) -> Handshakes:
        """What a peer with the key of ``V2V_KEYS`` says to a server that only listens."""
        with socket.create_server(("127.0.0.1", 0)) as server:
            peer: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.DEALER)
            try:
                peer.setsockopt(zmq.LINGER, 0)
                read_key(Path(os.environ[KEY_VARIABLE])).secure(peer)
                peer.connect(f"tcp://127.0.0.1:{server.getsockname()[1]}")
                link, _ = server.accept()
                with link:
                    link.sendall(_GREETING % b"CURVE".ljust(20, b"\0"))
                    said = b""
                    while len(said) < _GREETING_BYTES + _HELLO_BYTES:
                        said += link.recv(4096)
            finally:
                peer.close()
        return cls(said)

    def __call__(self, address: str, number: int) -> None:
        while True:
            with _connected(address) as peer:
                peer.sendall(self.said)
                answer = b""
                while len(answer) < _GREETING_BYTES + _WELCOME_BYTES and (piece := peer.recv(4096)):
                    answer += piece


KINDS: dict[str, Callable[[str, int], None]] = {
    each.__name__: each for each in (parts, headers, hello, leave, thief, look, idle, flood, trickle, slow)
}
REFUSED, HANDSHAKES = "refused", "handshakes"
KEYED_KINDS = (REFUSED, HANDSHAKES)


def attack(address: str, kind: str, act: Callable[[str, int], None]) -> NoReturn:
    """Sets :data:`PEERS` peers on a server, again when cut off, as long as this process lives."""

    def live(number: int) -> NoReturn:
        while True:
            with suppress(OSError, zmq.ZMQError):  # cut off, or the server is gone for now
                act(address, number)
            time.sleep(0.01)

    for number in range(1, 1 if kind == "slow" else PEERS):
        threading.Thread(target=live, args=(number,), daemon=True).start()
    live(0)


def _greeting(address: str) -> bytes:
    """The 64 bytes with which a peer says how it wants to speak: as that address asks for, or else plainly."""
    return _GREETING % (b"CURVE" if address and key_for(address, "consumer", None) else b"NULL").ljust(20, b"\0")


@contextmanager
def _raw(address: str) -> Iterator[socket.socket]:
    """A peer that speaks ZMTP by hand, past the handshake."""
    with _connected(address) as peer:
        peer.sendall(_greeting("") + _READY)
        yield peer


def _connected(address: str) -> socket.socket:
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    link = socket.create_connection((host, int(port)), 5.0, (_ELSEWHERE, 0) if host == "127.0.0.1" else None)
    _count()
    return link


def _count() -> None:
    """One more connection, or one more handshake that was refused."""
    if _tally is not None:
        with _tally.open("ab") as file:
            file.write(b".")


def _from_elsewhere(address: str) -> str:
    """The same for ZeroMQ."""
    return address.replace("tcp://127.0.0.1:", f"tcp://{_ELSEWHERE}:0;127.0.0.1:")


@contextmanager
def _dealer(address: str, number: int | bytes | None) -> Iterator[zmq.Socket[bytes]]:
    """Connect a peer that takes one message at a time.

    Args:
        address: of the server.
        number: of the peer, which makes its routing id; or that id; None takes a new one.
    """
    peer: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.DEALER)
    try:
        if isinstance(number, bytes):
            name = number
        else:
            name = b"leaver-" + os.urandom(8) if number is None else b"hostile-%d-%d" % (os.getpid(), number)
        peer.setsockopt(zmq.ROUTING_ID, name)
        peer.setsockopt(zmq.LINGER, 0)
        peer.setsockopt(zmq.RCVHWM, 1)
        peer.setsockopt(zmq.SNDTIMEO, 2000)
        if key := key_for(address, "consumer", None):
            key.secure(peer)
        peer.connect(_from_elsewhere(address))
        yield peer
    finally:
        peer.close()


def main(arguments: Sequence[str] | None = None) -> NoReturn:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m bench.chaos.hostile", description=__doc__)
    parser.add_argument("--address", required=True)
    parser.add_argument("--kind", required=True, choices=(*KINDS, *KEYED_KINDS))
    parser.add_argument("--worker-address", help="for refused: the other port")
    parser.add_argument("--revoked", type=Path, help="for refused: a revoked key")
    parser.add_argument(
        "--tally", type=Path, help="a file that grows by a byte with every raw connection and every refused handshake"
    )
    asked = parser.parse_args(arguments)
    global _tally
    _tally = asked.tally
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(0))
    if asked.kind == REFUSED:
        act: Callable[[str, int], None] = Refused(asked.worker_address, asked.revoked)
    else:
        act = Handshakes.recorded() if asked.kind == HANDSHAKES else KINDS[asked.kind]
    attack(asked.address, asked.kind, act)


if __name__ == "__main__":
    main()
