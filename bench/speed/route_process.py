"""The processes of a route (:mod:`bench.speed.routes`): ``python -m bench.speed.route_process ROLE FOLDER``.

The folder lies in memory where the system has such a place, and holds what they share:

    route.json          the route, keys and layout
    <array>.npy         [samples, ...] the arrays to send
    provenance.json     of each sample
    slots               shared memory of the ``shared`` routes: one slot a sample of the window
    counts              two int64: samples that arrived, and bytes of their arrays on the wire

Nothing here imports torch, so that they start at once.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import zmq

from v2v_protocol.errors import ProtocolError
from v2v_protocol.messages import SampleHeader
from v2v_protocol.wire import decode, decode_sample, encode_sample
from v2v_server.system.process import die_with_parent, keep_freed_memory

SPARSE = "voxels"
"""The array that codecs are put to; camera pictures hardly shrink."""

Codec = tuple[Callable[[Any], bytes], Callable[[Any], bytes]]


def _zstd() -> Codec:
    zstd = import_module("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")
    return (lambda raw: zstd.compress(raw, 1)), zstd.decompress


def _lz4() -> Codec:
    frame = import_module("lz4.frame")
    return frame.compress, frame.decompress


def _blosc2() -> Codec:
    blosc2 = import_module("blosc2")
    settings: dict[str, Any] = {"typesize": 1, "clevel": 1, "filter": blosc2.Filter.BITSHUFFLE}
    return (lambda raw: blosc2.compress(raw, **settings)), blosc2.decompress


CODECS: Mapping[str, Callable[[], Codec]] = {"zstd-1": _zstd, "lz4": _lz4, "blosc2": _blosc2}


def missing(codec: str) -> str | None:
    """Why a codec cannot be used here; None when it can."""
    try:
        CODECS[codec]()
    except ImportError as error:
        return f"Python package {error.name} is not installed"
    return None


class Folder:
    """What the processes of a route share.

    Args:
        path: the folder, see the module.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.route: dict[str, Any] = json.loads((path / "route.json").read_text(encoding="utf-8"))
        self.window: int = self.route["window"]
        self.layout: dict[str, tuple[str, list[int]]] = self.route["layout"]

    def counts(self) -> npt.NDArray[np.int64]:
        """[2]: samples that arrived, bytes of their arrays on the wire."""
        return np.memmap(self.path / "counts", np.int64, "r+", shape=(2,))

    def slots(self) -> dict[str, npt.NDArray[Any]]:
        """Views of the shared memory: every array with a leading dimension of slots; none where it is not used."""
        views: dict[str, npt.NDArray[Any]] = {}
        offset = 0
        for name, (dtype, shape) in self.layout.items() if self.route["payload"] != "message" else ():
            file = self.path / "slots"
            # np.asarray: indexing a memmap costs far more than indexing an array.
            views[name] = np.asarray(np.memmap(file, dtype, "r+", offset=offset, shape=(self.window, *shape)))
            offset += views[name].nbytes
        return views


def connect(kind: int, name: bytes) -> zmq.Socket[bytes]:
    """A socket without high-water marks: requests bound what is queued."""
    link: zmq.Socket[bytes] = zmq.Context.instance().socket(kind)
    link.setsockopt(zmq.SNDHWM, 0)
    link.setsockopt(zmq.RCVHWM, 0)
    link.setsockopt(zmq.ROUTING_ID, name)
    return link


def listen(link: zmq.Socket[bytes], route: Mapping[str, Any]) -> None:
    """Binds the receiver's side, and says on standard output where."""
    if route["curve"]:
        link.curve_server = True
        link.curve_publickey, link.curve_secretkey = (key.encode() for key in route["server_keys"])
    link.bind("tcp://127.0.0.1:*")
    print(link.getsockopt_string(zmq.LAST_ENDPOINT), flush=True)


def send(folder: Folder) -> None:
    """Answers each request with the next sample."""
    keep_freed_memory()
    route, slots = folder.route, folder.slots()
    link = connect(zmq.DEALER, b"sender")
    if route["relay"]:
        link.connect(f"ipc://{folder.path}/workers")
        link.send(b"")
    else:
        listen(link, route)
    stacks = {name: np.load(folder.path / f"{name}.npy") for name in folder.layout}
    provenance = json.loads((folder.path / "provenance.json").read_text(encoding="utf-8"))
    compress = CODECS[route["codec"]]()[0] if route["codec"] else bytes
    for number in range(sys.maxsize):
        slot = link.recv()
        which = number % len(provenance)
        arrays = {name: stack[which] for name, stack in stacks.items()}
        header, *raw = encode_sample(
            epoch=0, index=number, arrays=arrays, provenance=provenance[which], worker="", cpu_seconds=0.0
        )
        frames: list[Any] = []
        if route["payload"] == "message":
            named = zip(arrays, raw, strict=True)
            frames = [compress(data) if route["codec"] and name == SPARSE else data for name, data in named]
        elif route["payload"] == "shared":
            for name, array in arrays.items():
                slots[name][int.from_bytes(slot, "big")] = array
        link.send_multipart([slot, header, *frames], copy=False)


def relay(folder: Folder) -> None:
    """Passes requests one way and samples the other, unopened."""
    keep_freed_memory()
    workers, consumers = connect(zmq.ROUTER, b"workers"), connect(zmq.ROUTER, b"consumers")
    workers.bind(f"ipc://{folder.path}/workers")
    workers.recv_multipart()  # the sender is there: what is asked of it can be passed on
    listen(consumers, folder.route)
    poller = zmq.Poller()
    poller.register(workers, zmq.POLLIN)
    poller.register(consumers, zmq.POLLIN)
    while True:
        ready = dict(poller.poll())
        if workers in ready:
            _, *frames = workers.recv_multipart(copy=False)
            consumers.send_multipart([b"receiver", *frames], copy=False)
        if consumers in ready:
            _, *request = consumers.recv_multipart()
            workers.send_multipart([b"sender", *request])


def receive(folder: Folder, address: str) -> None:
    """Asks for samples and copies them into the rows of a batch.

    Raises:
        ProtocolError: what comes is no sample.
    """
    route, slots, counts = folder.route, folder.slots(), folder.counts()
    if route["keep"]:
        keep_freed_memory()
    link = connect(zmq.DEALER, b"receiver")
    if route["curve"]:
        link.curve_serverkey = route["server_keys"][0].encode()
        link.curve_publickey, link.curve_secretkey = (key.encode() for key in route["client_keys"])
    link.connect(address)
    decompress = CODECS[route["codec"]]()[1] if route["codec"] else bytes
    rows = folder.window // 2
    batch = {name: np.empty((rows, *shape), dtype) for name, (dtype, shape) in folder.layout.items()}
    for number in range(folder.window):
        link.send(number.to_bytes(2, "big"))
    for number in range(sys.maxsize):
        slot, frame, *payload = link.recv_multipart(copy=False)
        header = decode(frame.buffer)
        if not isinstance(header, SampleHeader):
            raise ProtocolError(f"the sender sent {type(header).__name__}")
        if route["payload"] == "message":
            coded = [bool(route["codec"]) and name == SPARSE for name in header.names]
            buffers = zip(coded, (data.buffer for data in payload), strict=True)
            arrays = decode_sample(header, [memoryview(decompress(data)) if yes else data for yes, data in buffers])
        else:
            arrays = {name: view[int.from_bytes(slot.buffer, "big")] for name, view in slots.items()}
        for name, array in arrays.items():
            batch[name][number % rows] = array
        link.send(slot.bytes)
        counts += 1, sum(len(data) for data in payload)


def main(role: str, folder: str, parent_pid: str, *address: str) -> None:
    """One process; it ends when it is killed."""
    die_with_parent(int(parent_pid))
    work: dict[str, Callable[..., None]] = {"sender": send, "broker": relay, "receiver": receive}
    work[role](Folder(Path(folder)), *address)


if __name__ == "__main__":
    main(*sys.argv[1:])
