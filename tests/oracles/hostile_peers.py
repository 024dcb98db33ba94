"""Hostile consumers and workers of a live server.

    noise     frames of every form, on either port, from peers that sent no Hello
    deaf      the same from peers that never read an answer, for the whole attack
    greedy    a consumer that sends a valid Hello, then requests too much, what does not exist, and the same twice
    liar      a worker that sends a valid hello, takes leases and answers with anything but a sample: wrong numbers,
              wrong indices, no payload, a payload of noise
    bytes     plain TCP connections that do not speak ZMTP

A server trusts its workers not to refuse good videos and not to send wrong pixels in a valid sample; these are left
out.
"""

from __future__ import annotations

import random
import socket
import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

import zmq

from tests.oracles.hostile_frames import FrameFuzzer
from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.errors import ProtocolError
from v2v_protocol.keys import read_key
from v2v_protocol.link.dealer import secure
from v2v_protocol.messages import (
    Begun,
    Buffer,
    Goodbye,
    Hello,
    Lease,
    Message,
    Ping,
    Pong,
    Result,
    Want,
    WorkerHello,
    decode,
    encode,
    encode_sample,
)

_BURST = 100
_SPEC = {"recipe": {"preset": "paper", "voxels_per_clip": 4, "crop_height_px": 32, "crop_width_px": 40}}
_ANSWER_SECONDS = 120.0
_ASK_SECONDS = 5.0
_CONNECT_SECONDS = 1.0


class Attack:
    """An attack on both ports of a server.

    Args:
        address, worker_address: of the server.
        random_source: of everything that is sent.
        keys: key file for each address; empty: connect without keys.

    Attributes:
        sent: messages, by kind of peer.
        longest_seconds: longest time that the server took to answer a Ping between two bursts.
    """

    def __init__(
        self, address: str, worker_address: str, random_source: random.Random, keys: Mapping[str, Path]
    ) -> None:
        self._keys = {where: read_key(file) for where, file in keys.items()}
        self._address = address
        self._worker_address = worker_address
        self._random = random_source
        self._fuzzer = FrameFuzzer(random_source)
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._names = 0
        self._deaf = [self._connect(where) for where in (address, worker_address)]
        self.sent: Counter[str] = Counter()
        self.longest_seconds = 0.0

    def __enter__(self) -> Attack:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._context.destroy(linger=0)

    def send(self, messages: int) -> None:
        """Send about that many messages in bursts from new peers; wait for the server between two bursts."""
        until = self.sent.total() + messages
        bursts = (self._noise, self._noise, self._greedy, self._liar, self._bytes)
        while self.sent.total() < until:
            self._random.choice(bursts)()
            if not self.answered():
                return

    def answered(self) -> bool:
        """Return whether the server still answers, on both ports."""
        began = time.monotonic()
        for address in (self._address, self._worker_address):
            prober = self._connect(address)
            try:
                # As the client does, it asks again: a message is lost with a connection that is ended.
                while True:
                    prober.send_multipart(encode(Ping()))
                    if prober.poll(int(_ASK_SECONDS * 1000)):
                        break
                    if time.monotonic() > began + _ANSWER_SECONDS:
                        return False
            finally:
                prober.close(linger=0)
        self.longest_seconds = max(self.longest_seconds, time.monotonic() - began)
        return True

    def _connect(self, address: str) -> zmq.Socket[bytes]:
        peer = self._context.socket(zmq.DEALER)
        self._names += 1
        peer.setsockopt(zmq.ROUTING_ID, b"hostile-%d" % self._names)
        peer.setsockopt(zmq.LINGER, 1000)
        peer.setsockopt(zmq.SNDHWM, 0)
        if self._keys:
            secure(peer, self._keys[address])
        peer.connect(address)
        return peer

    def _noise(self) -> None:
        side = self._random.randrange(2)
        deaf = self._random.random() < 0.3
        peer = self._deaf[side] if deaf else self._connect((self._address, self._worker_address)[side])
        for _ in range(_BURST):
            self._send(peer, "deaf" if deaf else "noise", *self._fuzzer.message())
            if not deaf:
                _read(peer, 0)
        if not deaf:
            peer.close()

    def _greedy(self) -> None:
        peer = self._connect(self._address)
        spec = _SPEC if self._random.random() < 0.8 else {"recipe": "paper"}
        self._send(peer, "greedy", *encode(Hello(spec, ("voxels",), self._random.choice((1, 2, 50)), 1)))
        _read(peer, 1000)
        for _ in range(_BURST):
            epoch = self._random.choice((0, 0, 1, 2**31, 2**64 - 1))
            count = self._random.choice((0, 1, 2, 2, 5, 200, 60_000))
            first = self._random.choice((0, 0, 3, 10**6, 2**64 - 60_001))
            self._send(peer, "greedy", *encode(Want(epoch, tuple(range(first, first + count)))))
            if self._random.random() < 0.2:
                self._send(peer, "greedy", *self._fuzzer.message())
            _read(peer, 0)
        if self._random.random() < 0.5:
            self._send(peer, "greedy", *encode(Goodbye()))
        peer.close()

    def _liar(self) -> None:
        peer = self._connect(self._worker_address)
        credit = self._random.choice((0, 1, 2, 2**64 - 1))
        self._send(peer, "liar", *encode(WorkerHello("liar", NUMERICS_VERSION, credit)))
        leases: list[Lease] = []
        for _ in range(_BURST):
            leases += [message for message in _read(peer, 1) if isinstance(message, Lease)]
            lease = leases.pop() if leases else None
            number = self._random.randrange(1, 10_000) if lease is None else lease.lease
            index = 0 if lease is None else lease.indices[0]
            if self._random.random() < 0.3:
                self._send(peer, "liar", *encode(Begun(number)))
            header = encode(Result(number, self._random.choice((0, number, number + 1))))
            self._send(peer, "liar", *header, *self._payload(self._random.choice((index, index + 1))))
        self._send(peer, "liar", *encode(Goodbye()))
        peer.close()

    def _payload(self, index: int) -> list[Buffer]:
        match self._random.randrange(5):
            case 0:
                return []
            case 1:
                return list(self._fuzzer.message())
            case 2:
                header, raw = self._fuzzer.sample()
                return [*encode(header), *raw]
            case 3:
                return [b"", *(self._fuzzer.noise() for _ in range(50))]
            case _:
                return list(
                    encode_sample(epoch=0, index=index, arrays={}, provenance={}, worker="liar", cpu_seconds=1e300)
                )

    def _bytes(self) -> None:
        for address in (self._address, self._worker_address):
            host, _, port = address.removeprefix("tcp://").rpartition(":")
            with socket.create_connection((host, int(port)), _CONNECT_SECONDS) as plain:
                # Some begin with a valid ZMTP greeting.
                greeting = b"\xff" + bytes(8) + b"\x7f\x03\x00NULL" if self._random.random() < 0.5 else b""
                plain.sendall(greeting + self._random.randbytes(self._random.randrange(2000)))
            self.sent["bytes"] += 1

    def _send(self, peer: zmq.Socket[bytes], kind: str, *frames: Buffer) -> None:
        peer.send_multipart(frames)
        self.sent[kind] += 1


def _read(peer: zmq.Socket[bytes], wait_ms: int) -> list[Message]:
    """Return the messages that have arrived; skip what is not valid."""
    found = []
    while peer.poll(wait_ms):
        wait_ms = 0
        try:
            found.append(decode(peer.recv_multipart()[0]))
        except ProtocolError:
            continue
    return [message for message in found if not isinstance(message, Pong)]
