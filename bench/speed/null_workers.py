"""A server with null workers: workers that answer every lease at once with constant arrays, or with samples made ahead.

They connect to ``v2v-serve --worker-bind`` and speak the workers' protocol, so that such a server does the work of the
broker and nothing else. All of them are sockets of one process, because 64 interpreters would compete for the cores.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import tempfile
import time
from collections import defaultdict, deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bench.processes import Roles
from tests.clips import write_clip
from tests.oracles.dealers import NextDealer, wait
from v2v_client.local_server import LocalServer
from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.errors import RemoteError, ServerLost
from v2v_protocol.link.dealer import Dealer
from v2v_protocol.messages import (
    Begun,
    Denied,
    Goodbye,
    Lease,
    Message,
    Ping,
    Pong,
    Result,
    Stop,
    WorkerHello,
    decode,
    encode,
    encode_sample,
)
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import Provenance, SampleId, SampleParams
from v2v_server.system.process import die_with_parent, keep_freed_memory
from v2v_server.worker.job import ClipJob
from v2v_server.worker.process import open_output_buffer, pack, sample_message

Ready = Mapping[str, npt.NDArray[Any]]  # Samples made ahead: [samples, ...] of each array

CREDIT = 2  # Leases that each holds at a time, as a real worker does
_PING_SECONDS = 5.0
_JOIN_POLL_SECONDS = 0.1
_SEQUENCES_PER_VIDEO = 2

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
"""The camera in the provenance of every sample."""


class NullWorkers:
    """``count`` null workers in one thread.

    Args:
        address: of the server's workers.
        count: number of null workers.
        joined: set once the server knows all of them.
        samples: as for :func:`answer`.
    """

    def __init__(self, address: str, count: int, joined: Event, samples: Ready | None) -> None:
        self._samples = samples
        self._joined = joined
        self._first = Dealer(address, "", "worker")
        self._names: dict[Dealer, str] = {}
        self._stopped: list[Dealer] = []
        self._joining: set[Dealer] = set()
        self._leases: dict[Dealer, deque[Lease]] = defaultdict(deque)
        self._begun: dict[Dealer, int] = {}
        for number in range(count):
            link = NextDealer(self._first, address, "", "worker")
            name = f"null-{os.getpid()}-{number}"
            link.connect()
            self._names[link] = name
            link.send(encode(WorkerHello(name, NUMERICS_VERSION, CREDIT)))
            # The server does not answer a hello; it answers the ping after it.
            self._joining.add(link)
            link.send(encode(Ping()))

    def run(self) -> None:
        """Answer leases until the server stops all workers.

        Raises:
            RemoteError: the server refuses a worker.
        """
        next_ping = time.monotonic() + _PING_SECONDS
        try:
            while self._names:
                waiting = not any(self._leases.values())
                for link in wait([*self._names], _PING_SECONDS if waiting else 0):
                    if (frames := link.receive(0)) is not None:
                        self._handle(link, decode(frames[0]))
                for link, leases in self._leases.items():
                    if leases:
                        self._answer(link, leases)
                if time.monotonic() >= next_ping:
                    next_ping = time.monotonic() + _PING_SECONDS
                    for link in self._names:
                        link.send(encode(Ping()))
        finally:
            for link in (*self._stopped, *self._names, self._first):
                link.close()

    def _handle(self, link: Dealer, message: Message) -> None:
        match message:
            case Lease():
                self._leases[link].append(message)
            case Pong() if link in self._joining:
                self._joining.remove(link)
                if not self._joining:
                    self._joined.set()
            case Stop():
                link.send(encode(Goodbye()))
                del self._names[link]
                self._stopped.append(link)
                self._leases.pop(link, None)
            case Denied(code, text):
                raise RemoteError(code, text)

    def _answer(self, link: Dealer, leases: deque[Lease]) -> None:
        """Answer the oldest lease with the messages of a worker that already holds the next one."""
        lease = leases.popleft()
        if self._begun.get(link) != lease.lease:
            link.send(encode(Begun(lease.lease)))
        begins = self._begun[link] = leases[0].lease if leases else 0
        frames = answer(lease, self._names[link], self._samples)
        link.send([*encode(Result(lease.lease, begins)), *frames])


def answer(lease: Lease, name: str, samples: Ready | None = None) -> list[Any]:
    """Return the frames of a sample message that fits the lease.

    Args:
        lease: to answer.
        name: of the worker.
        samples: arrays to send, in turn; None sends ones.
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
    buffer = open_output_buffer(lease, ClipJob.of(lease).layout)
    # Untouched memory is one shared page of zeros, which is nearly free to send.
    for array in buffer.arrays.values():
        array.fill(1)
    return sample_message(lease, buffer, provenance=provenance.to_dict(), worker=name, cpu_seconds=0.0)


_packed: dict[int, list[bytes]] = {}


def _ready_message(lease: Lease, name: str, provenance: Provenance, samples: Ready) -> list[Any]:
    """Return the message of a sample made ahead; each is compressed once."""
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


@dataclass(frozen=True, slots=True)
class NullService:
    """A running server: the broker's process, and the process of all null workers."""

    server: LocalServer
    workers_pid: int

    @property
    def roles(self) -> Roles:
        """Return the processes of the null workers, the broker, and the client (this process)."""
        return {"workers": [self.workers_pid], "broker": [self.server.pid], "client": [os.getpid()]}


@contextmanager
def null_service(
    recipe: Recipe, *, workers: int, sequences: int = 240, flags: Sequence[str] = (), samples: Path | None = None
) -> Iterator[NullService]:
    """Start a server with null workers on small videos; stop it at the end of the block.

    Args:
        recipe: of the server.
        workers: null workers.
        sequences: least number in an epoch; the end of an epoch costs a consumer a new session.
        flags: of ``v2v-serve``; they must give that recipe.
        samples: folder of the samples to send, ``NAME.npy`` of each array; None sends ones.

    Raises:
        ServerLost, UsageError: the server, or the null workers, do not start.
    """
    with tempfile.TemporaryDirectory(prefix="v2v-null-") as folder:
        corpus, address = Path(folder, "corpus"), f"ipc://{folder}/workers"
        corpus.mkdir()
        # As long as usual clips, because a lease carries part of the index of all frames.
        frames = (_SEQUENCES_PER_VIDEO - 1) * recipe.frames_per_sequence + recipe.frames_needed
        first = corpus / "0.mp4"
        height, width = (side + side % 2 for side in (recipe.crop_height_px, recipe.crop_width_px))
        write_clip(first, np.full((frames, height, width), 128, np.uint8), codec="mpeg4", gop=600)
        for number in range(1, -(-sequences // _SEQUENCES_PER_VIDEO)):
            (corpus / f"{number}.mp4").hardlink_to(first)
        own = ["--worker-bind", address, "--cache-dir", folder]
        with LocalServer(corpus, workers=0, flags=[*flags, *own]) as server:
            spawn = multiprocessing.get_context("spawn")
            joined = spawn.Event()
            process = spawn.Process(target=_work, args=(os.getpid(), address, workers, joined, samples))
            process.start()
            try:
                # A consumer that connects earlier gets the credit of a server without workers.
                while not joined.wait(_JOIN_POLL_SECONDS):
                    if process.exitcode is not None:
                        raise ServerLost("the null workers ended before they joined the server")
                yield NullService(server, process.pid or 0)
            finally:
                process.terminate()
                process.join()


def _work(parent_pid: int, address: str, count: int, joined: Event, folder: Path | None) -> None:
    """Run the process of the null workers."""
    die_with_parent(parent_pid)
    keep_freed_memory()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    samples = None if folder is None else {file.stem: np.load(file) for file in folder.glob("*.npy")}
    NullWorkers(address, count, joined, samples).run()
