"""Ways for a sample from the process that makes it to a trainer's batch, each with the processes it needs, to compare.

    sender ──► relay ──► receiver          a relay stands for the broker: it passes frames on unopened
    sender ────────────► receiver          without one

The receiver asks for samples (a window of two batches), and copies what comes into rows of a batch, as the client does.
The sender sends real samples that were made beforehand. ``shared`` routes put the arrays into shared memory and send
only the header: the receiver owns the slots and names a free one with each request. They are prototypes for measuring,
with no answer to a peer that dies.
"""

from __future__ import annotations

import dataclasses
import json
import os
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import zmq

from bench.speed.route_process import CODECS
from bench.usage import Meter
from v2v_protocol.errors import UsageError
from v2v_protocol.sample import Sample

_START_SECONDS = 60.0
_POLL_SECONDS = 0.01


@dataclass(frozen=True, slots=True)
class Route:
    """One way.

    Attributes:
        name: for the table.
        payload: "message": arrays travel in the message; "shared": they are copied into shared memory by the sender;
            "in place": they are there already, as if the simulation had written them there.
        codec: "", or a name in ``route_process.CODECS``: voxels are compressed.
        relay: whether a relay lies between sender and receiver.
        curve: whether the connection to the receiver is encrypted (CurveZMQ).
        keep: whether the receiver keeps freed memory (``v2v_client.keep_freed_memory``).
    """

    name: str
    payload: str = "message"
    codec: str = ""
    relay: bool = True
    curve: bool = False
    keep: bool = True


@dataclass(frozen=True, slots=True)
class Travelled:
    """What a measured stretch took.

    Attributes:
        batches: samples / batch size.
        seconds: wall time.
        cpu_seconds: by role: sender, broker (0 without one), receiver.
        wire_bytes: of array frames in messages.
    """

    batches: float
    seconds: float
    cpu_seconds: Mapping[str, float]
    wire_bytes: int


def missing(codec: str) -> str | None:
    """Why a codec cannot be used here; None when it can."""
    try:
        CODECS[codec]()
    except ImportError as error:
        return f"Python package {error.name} is not installed"
    return None


def travel(route: Route, samples: Sequence[Sample], *, batch_size: int, seconds: float) -> Travelled:
    """Sends samples round and round for that long, after two batches of warm-up.

    Raises:
        UsageError: a process of the route died, or nothing arrived.
    """
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    with tempfile.TemporaryDirectory(prefix="v2v-route-", dir=memory) as name:
        folder = Path(name)
        _prepare(folder, route, samples, window=2 * batch_size)
        counts = np.memmap(folder / "counts", np.int64, "r", shape=(2,))
        processes: dict[str, subprocess.Popen[str]] = {}

        def start(role: str, *arguments: str) -> None:
            command = [sys.executable, "-m", "bench.speed.route_process", role, name, str(os.getpid()), *arguments]
            processes[role] = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True)

        def wait(done: Callable[[], bool], longest_seconds: float) -> None:
            deadline = time.monotonic() + longest_seconds
            while not done():
                for role, process in processes.items():
                    if process.poll() is not None:
                        raise UsageError(f"route {route.name}: the {role} ended with status {process.returncode}")
                if time.monotonic() >= deadline:
                    raise UsageError(f"route {route.name}: too few samples in {longest_seconds:g} s")
                time.sleep(_POLL_SECONDS)

        try:
            start("sender")
            if route.relay:
                start("broker")
            announced = processes["broker" if route.relay else "sender"].stdout
            # Not read before something is there: the sender may die before the relay has heard of it.
            if announced is None:
                raise UsageError(f"route {route.name}: no pipe to the process that listens")
            wait(lambda: bool(select.select([announced], [], [], 0.0)[0]), _START_SECONDS)
            start("receiver", announced.readline().strip())
            wait(lambda: bool(counts[0] >= 2 * batch_size), _START_SECONDS)
            meter = Meter({role: [process.pid] for role, process in processes.items()})
            began, before = time.perf_counter(), counts.copy()
            wait(
                lambda: time.perf_counter() - began >= seconds and bool(counts[0] > before[0]), seconds + _START_SECONDS
            )
            used, elapsed, (arrived, nbytes) = meter.used(), time.perf_counter() - began, (counts - before).tolist()
        finally:
            for process in processes.values():
                process.kill()
                process.communicate()
    return Travelled(arrived / batch_size, elapsed, {"broker": 0.0, **used}, nbytes)


def _prepare(folder: Path, route: Route, samples: Sequence[Sample], window: int) -> None:
    """Writes what :mod:`bench.speed.route_process` reads."""
    first = samples[0].arrays
    keys = {f"{side}_keys": [key.decode() for key in zmq.curve_keypair()] for side in ("server", "client")}
    layout = {name: (array.dtype.str, array.shape) for name, array in first.items()}
    setting = {**dataclasses.asdict(route), **keys, "window": window, "layout": layout}
    (folder / "route.json").write_text(json.dumps(setting), encoding="utf-8")
    (folder / "counts").write_bytes(bytes(16))
    for name in first:
        np.save(folder / f"{name}.npy", np.stack([sample.arrays[name] for sample in samples]))
    provenance = [sample.provenance.to_dict() for sample in samples]
    (folder / "provenance.json").write_text(json.dumps(provenance), encoding="utf-8")
    with (folder / "slots").open("wb") as file:
        file.truncate(window * sum(array.nbytes for array in first.values()))
