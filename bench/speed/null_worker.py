"""Server workers that make nothing: every lease is answered at once with constant arrays of the right shapes, or with
samples that were made before (``--samples``).

    python -m bench.speed.null_worker --connect ADDRESS --workers 64

They come in by the door that all workers use (``v2v-serve --worker-bind``) and say what all workers say, so that what
such a server does is broker and wire and nothing else. All of them are sockets of one process: the server cannot tell,
and 64 interpreters would only be in each other's way.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import time
from collections import defaultdict, deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import zmq

from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.errors import RemoteError, V2VError
from v2v_protocol.messages import (
    Begun,
    Denied,
    ErrorCode,
    Goodbye,
    Lease,
    Message,
    Ping,
    Pong,
    Result,
    Stop,
    WorkerHello,
)
from v2v_protocol.sample import Provenance, SampleId, SampleParams
from v2v_protocol.wire import LARGEST_HEADER_BYTES, decode, encode, encode_sample
from v2v_server.system.process import die_with_parent, keep_freed_memory
from v2v_server.worker.output_buffer import open_output_buffer, pack, sample_message
from v2v_server.worker.produce import sample_layout

Ready = Mapping[str, npt.NDArray[Any]]
"""Samples that were made before: [samples, ...] of each array."""

CREDIT = 2
"""Leases that each of them holds at a time, like a real worker."""
_PING_SECONDS = 5.0

CAMERA = SampleParams(
    threshold_pos=0.25,
    threshold_neg=0.25,
    noise_sigma=0.0,
    hot_pixel_count=0,
    hot_pixel_sigma=0.0,
    pauses=(),
    scale=1.0,
    crop_top_px=0,
    crop_left_px=0,
    flip=False,
    contrast=0.0,
    noise_key=(0, 0, 0, 0),
)
"""What the provenance of every sample says; nothing was drawn."""


class NullWorkers:
    """A number of null workers, in one thread.

    Args:
        address: where the server listens for workers.
        count: how many.
        samples: see :func:`answer`.
    """

    def __init__(self, address: str, count: int, samples: Ready | None = None) -> None:
        self._samples = samples
        self._context = zmq.Context()
        self._poller = zmq.Poller()
        self._names: dict[zmq.Socket[bytes], str] = {}
        self._joining: set[zmq.Socket[bytes]] = set()
        self._leases: dict[zmq.Socket[bytes], deque[Lease]] = defaultdict(deque)
        self._begun: dict[zmq.Socket[bytes], int] = {}
        for number in range(count):
            link = self._context.socket(zmq.DEALER)
            name = f"null-{os.getpid()}-{number}"
            link.setsockopt(zmq.ROUTING_ID, name.encode())
            link.setsockopt(zmq.LINGER, 0)
            link.setsockopt(zmq.MAXMSGSIZE, LARGEST_HEADER_BYTES)
            link.setsockopt(zmq.SNDHWM, 0)
            link.setsockopt(zmq.RCVHWM, 0)
            link.connect(address)
            self._names[link] = name
            self._poller.register(link, zmq.POLLIN)
            self._say_hello(link)

    def run(self) -> None:
        """Answers until the server has stopped every one of them; says "joined" on standard output once it knows all.

        Raises:
            RemoteError: the server refuses them.
        """
        next_ping = time.monotonic() + _PING_SECONDS
        try:
            while self._names:
                waiting = not any(self._leases.values())
                for link, _ in self._poller.poll(int(_PING_SECONDS * 1000) if waiting else 0):
                    self._handle(link, decode(link.recv_multipart()[0]))
                for link, leases in self._leases.items():
                    if leases:
                        self._answer(link, leases)
                if time.monotonic() >= next_ping:
                    next_ping = time.monotonic() + _PING_SECONDS
                    for link in self._names:
                        link.send_multipart(encode(Ping()))
        finally:
            self._context.destroy(linger=0)

    def _say_hello(self, link: zmq.Socket[bytes]) -> None:
        hello = WorkerHello(self._names[link], NUMERICS_VERSION, CREDIT)
        link.send_multipart(encode(hello))
        # A hello is not answered; a ping is, and after it.
        self._joining.add(link)
        link.send_multipart(encode(Ping()))

    def _handle(self, link: zmq.Socket[bytes], message: Message) -> None:
        match message:
            case Lease():
                self._leases[link].append(message)
            case Pong() if link in self._joining:
                self._joining.remove(link)
                if not self._joining:
                    print("joined", flush=True)
            case Stop():
                link.send_multipart(encode(Goodbye()))
                self._poller.unregister(link)
                del self._names[link]
                self._leases.pop(link, None)
            case Denied(ErrorCode.UNKNOWN_SESSION):
                self._leases.pop(link, None)
                self._begun.pop(link, None)
                self._say_hello(link)
            case Denied(code, text):
                raise RemoteError(code, text)
            case _:
                pass

    def _answer(self, link: zmq.Socket[bytes], leases: deque[Lease]) -> None:
        """Answers the oldest lease in as many messages as a worker sends that has another one at hand."""
        lease = leases.popleft()
        if self._begun.get(link) != lease.lease:
            link.send_multipart(encode(Begun(lease.lease)))
        begins = self._begun[link] = leases[0].lease if leases else 0
        frames = answer(lease, self._names[link], self._samples)
        link.send_multipart([*encode(Result(lease.lease, begins)), *frames], copy=False)


def answer(lease: Lease, name: str, samples: Ready | None = None) -> list[Any]:
    """The frames of a whole sample message that fits the lease.

    Args:
        lease: what was asked.
        name: of the worker.
        samples: arrays to send, in turn, of the leases' form; None sends ones.
    """
    index = lease.indices[0]
    provenance = Provenance(
        id=SampleId(lease.spec_digest, lease.catalogue_digest, NUMERICS_VERSION, lease.seed, lease.epoch, index),
        video=lease.video,
        fingerprint=lease.fingerprint,
        start_frame=lease.start_frame,
        candidate=lease.candidate,
        refusals=(),
        params=CAMERA,
        saturated_bins=0,
        irregular_timestamps=0,
        decoder="none",
        quarantine=lease.quarantine,
    )
    if samples is not None:
        return _ready_message(lease, name, provenance, samples)
    buffer = open_output_buffer(lease, sample_layout(lease))
    # Memory that nobody wrote to is one page of zeros to the kernel, and nearly free to send.
    for array in buffer.arrays.values():
        array.fill(1)
    return sample_message(lease, buffer, provenance=provenance.to_dict(), worker=name, cpu_seconds=0.0)


_packed: dict[int, list[bytes]] = {}


def _ready_message(lease: Lease, name: str, provenance: Provenance, samples: Ready) -> list[Any]:
    """A sample that was made before, and is compressed once only."""
    index = lease.indices[0]
    number = index % len(samples[lease.arrays[0]])
    arrays = {each: samples[each][number] for each in lease.arrays}
    if lease.packed and number not in _packed:
        _packed[number] = [pack(array.reshape(-1).view("uint8").data) for array in arrays.values()]
    ready = iter(_packed.get(number, ()))
    return encode_sample(
        epoch=lease.epoch, index=index, arrays=arrays, provenance=provenance.to_dict(), worker=name, cpu_seconds=0.0,
        decoded=True, cache="", slot=lease.slot, in_slot=False, quarantine=lease.quarantine,
        pack=(lambda raw: next(ready)) if lease.packed else None,
    )  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line. Returns the exit status: 0, or 2 when the server refuses us."""
    parser = argparse.ArgumentParser(
        prog="python -m bench.speed.null_worker", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("--connect", required=True, metavar="ADDRESS", help="the server's --worker-bind")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="how many (default 1)")
    parser.add_argument("--samples", type=Path, metavar="DIR", help="what they send: NAME.npy of each array")
    parser.add_argument("--parent-pid", type=int, metavar="PID", help="end when this process does")
    asked = parser.parse_args(arguments)
    if asked.parent_pid is not None:
        die_with_parent(asked.parent_pid)
    keep_freed_memory()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    samples = None if asked.samples is None else {file.stem: np.load(file) for file in asked.samples.glob("*.npy")}
    try:
        NullWorkers(asked.connect, asked.workers, samples).run()
    except (V2VError, zmq.ZMQError) as error:
        print(f"null_worker: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
