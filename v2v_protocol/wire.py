"""Encode messages to the frames of a ZeroMQ multipart message, and decode them.

Frame 0 is a msgpack map: ``{"v": protocol version, "t": type name, ...fields}``. A SampleHeader is followed by one raw
frame per array; a Result by the frames of a whole SampleHeader message, which a broker passes on unchanged.

All received data is treated as hostile: sizes are limited before anything is allocated, types are checked field by
field, dtypes come from an allow-list, and nothing is ever unpickled. For any bytes, :func:`decode` either returns a
message or raises a :class:`v2v_protocol.errors.ProtocolError`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import msgpack
import numpy as np
import numpy.typing as npt

from v2v_protocol import PROTOCOL_VERSION
from v2v_protocol.arena import NO_SLOT
from v2v_protocol.errors import LimitExceeded, ProtocolError, VersionMismatch
from v2v_protocol.messages import (
    Begun,
    Denied,
    GetStatus,
    Goodbye,
    Hello,
    Lease,
    LeaseFailed,
    Message,
    Ping,
    Pong,
    Result,
    SampleHeader,
    Status,
    Stop,
    Unavailable,
    Want,
    Welcome,
    WorkerHello,
)
from v2v_protocol.persisted import add_fields, reader, shown

LARGEST_HEADER_BYTES = 1 << 20
"""Frame 0. The largest in use is a Lease: a frame index of a few thousand frames is a few kilobytes."""
LARGEST_REQUEST_BYTES = 1 << 16
"""A consumer's message. The largest in use is a Want of all its credit, with the name of an arena for each index."""
MOST_CONTAINERS = 4096
"""Lists and maps in a header. They cost a hundred times their bytes; a Lease, the largest in use, has some dozens."""
LARGEST_ARRAY_BYTES = 1 << 31
MOST_IN_FLIGHT_BYTES = 512 << 20
"""Bytes on their way to all peers of a socket above which one that takes nothing is disconnected."""
ARRAY_DTYPES = ("int8", "uint8", "int16", "uint16", "float16", "float32")
_DTYPE_NAMES = {np.dtype(name): name for name in ARRAY_DTYPES}
_ENCRYPTION_BYTES = 64
"""Bytes added to a frame by encryption; CURVE adds 33."""
_MOST_ARRAYS = 16
_MOST_DIMENSIONS = 8

Buffer: TypeAlias = bytes | bytearray | memoryview
Frames: TypeAlias = list[Buffer]

_TYPES: dict[str, type[Message]] = {
    "hello": Hello,
    "want": Want,
    "ping": Ping,
    "goodbye": Goodbye,
    "welcome": Welcome,
    "sample": SampleHeader,
    "unavailable": Unavailable,
    "denied": Denied,
    "pong": Pong,
    "worker-hello": WorkerHello,
    "begun": Begun,
    "result": Result,
    "lease-failed": LeaseFailed,
    "lease": Lease,
    "stop": Stop,
    "see": GetStatus,
    "seen": Status,
}
_NAMES = {cls: name for name, cls in _TYPES.items()}
_plain_map = reader(Mapping[str, Any])


def encode(message: Message) -> Frames:
    """Encode a message's header frame, alone in a list so that payload frames can be appended.

    Raises:
        LimitExceeded: the header is larger than any peer accepts.
    """
    name = _NAMES[type(message)]
    header = msgpack.packb(add_fields({"v": PROTOCOL_VERSION, "t": name}, message), use_bin_type=True)
    if len(header) > LARGEST_HEADER_BYTES:
        raise LimitExceeded(f"a {name} header of {len(header)} bytes; the limit is {LARGEST_HEADER_BYTES}")
    return [header]


def encode_sample(
    *,
    epoch: int,
    index: int,
    arrays: Mapping[str, npt.NDArray[Any]],
    provenance: Mapping[str, Any],
    worker: str,
    cpu_seconds: float,
    decoded: bool = True,
    cache: str = "",
    slot: int = NO_SLOT,
    in_slot: bool = False,
    quarantine: int = 0,
    pack: Callable[[Buffer], bytes] | None = None,
) -> Frames:
    """Encode a whole SampleHeader message. The arrays are not copied (except by ``pack``): do not change them until
    they are sent.

    Args:
        slot: the slot that the lease named.
        in_slot: the arrays lie there, so only the header is sent.
        pack: compresses an array's bytes to a zstd frame that states its size; None sends them uncompressed.
        epoch, index, arrays, provenance, worker, cpu_seconds, decoded, cache, quarantine: see :class:`SampleHeader`.

    Raises:
        LimitExceeded: an array dtype is not on the allow-list, or an array is not C-contiguous.
    """
    shapes: list[int] = []
    for name, array in arrays.items():
        if array.dtype not in _DTYPE_NAMES or not array.flags.c_contiguous:
            order = "" if array.flags.c_contiguous else "not "
            raise LimitExceeded(
                f"array {name} has dtype {array.dtype} and is {order}C-contiguous; samples have C-contiguous arrays of "
                f"{', '.join(ARRAY_DTYPES)}"
            )
        shapes += [array.ndim, *array.shape]
    header = SampleHeader(
        epoch=epoch,
        index=index,
        names=tuple(arrays),
        dtypes=tuple(_DTYPE_NAMES[array.dtype] for array in arrays.values()),
        shapes=tuple(shapes),
        provenance=encode_map(provenance),
        worker=worker,
        cpu_seconds=cpu_seconds,
        decoded=decoded,
        cache=cache,
        slot=slot,
        quarantine=quarantine,
        packed=pack is not None and not in_slot,
    )
    if in_slot:
        return encode(header)
    raw = [array.reshape(-1).view(np.uint8).data for array in arrays.values()]
    return [*encode(header), *(raw if pack is None else map(pack, raw))]


def encode_map(fields: Mapping[str, Any]) -> bytes:
    """Encode plain values as a field of a message that is passed on without decoding it."""
    packed: bytes = msgpack.packb(fields, use_bin_type=True)
    return packed


def decode_map(packed: bytes) -> dict[str, Any]:
    """Decode the result of :func:`encode_map`.

    Raises:
        ProtocolError: it is not a map, or is nested too deeply.
    """
    return _plain_map(_unpacked(packed, "a map"))


def decode(header: Buffer, most_bytes: int = LARGEST_HEADER_BYTES) -> Message:
    """Decode the message in a header frame.

    Args:
        header: the frame.
        most_bytes: size limit of the frame.

    Raises:
        VersionMismatch: the peer speaks another version.
        LimitExceeded: the frame, or a list in it, is too large, or nested too deeply.
        ProtocolError: any other malformed message.
    """
    if len(header) > most_bytes:
        raise LimitExceeded(f"a header of {len(header)} bytes; the limit is {most_bytes}")
    fields = _unpacked(header, "a message")
    if not isinstance(fields, dict) or "v" not in fields or "t" not in fields:
        raise ProtocolError("not a message: no version or type")
    version = fields.pop("v")
    if version != PROTOCOL_VERSION or type(version) is not int:
        raise VersionMismatch(
            f"the peer speaks protocol version {shown(version)}, this side version {PROTOCOL_VERSION}"
        )
    name = fields.pop("t")
    cls = _TYPES.get(name) if type(name) is str else None
    if cls is None:
        raise ProtocolError(f"unknown message type {shown(name)}")
    message: Message = cls.from_dict(fields)
    return message


def largest_packed_bytes(size: int) -> int:
    """Return the largest compressed size of an array of this many bytes: noise grows by a 256th and a little."""
    return size + size // 256 + 64


def largest_frame_bytes(sizes: Iterable[int]) -> int:
    """Return the largest size that ZeroMQ counts for a frame of a sample with arrays of these sizes, compressed and
    encrypted or not.

    A larger frame disconnects its sender (MAXMSGSIZE), so a limit one byte too small would break every stream.
    """
    return max(LARGEST_HEADER_BYTES, *(largest_packed_bytes(size) + _ENCRYPTION_BYTES for size in sizes))


def decode_sample(
    header: SampleHeader, payload: Sequence[Buffer], unpack: Callable[[Buffer, int], Buffer] | None = None
) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays behind a SampleHeader, as read-only views of the payload (no copy).

    Args:
        header, payload: of the sample.
        unpack: takes a packed array's frame and its number of bytes, and returns these bytes; it raises ProtocolError
            for any other content. None: packed samples are refused.

    Raises:
        ProtocolError, LimitExceeded: names, dtypes, shapes and frame lengths do not agree, or break a limit.
    """
    if len(header.names) != len(payload):
        raise ProtocolError(
            f"sample: {len(header.names)} names, {len(header.dtypes)} dtypes and {len(payload)} raw frames: "
            "the numbers must be equal"
        )
    if header.packed and unpack is None:
        raise ProtocolError("sample: its arrays are compressed, but compression was not requested")
    arrays: dict[str, npt.NDArray[Any]] = {}
    for (name, (dtype, shape)), raw in zip(layout_of(header).items(), payload, strict=True):
        size = math.prod(shape) * np.dtype(dtype).itemsize
        if header.packed and unpack is not None:
            raw = unpack(raw, size)
        if size != len(raw):
            raise ProtocolError(f"sample: array {name!r:.40} {dtype}{list(shape)} is {size} bytes, got {len(raw)}")
        array = np.frombuffer(raw, dtype=np.dtype(dtype)).reshape(shape)
        array.flags.writeable = False
        arrays[name] = array
    return arrays


def layout_of(header: SampleHeader) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Return dtype and shape of each array of a sample, as its header states them.

    Raises:
        ProtocolError, LimitExceeded: names, dtypes and shapes do not agree, or break a limit.
    """
    if len(header.names) != len(header.dtypes):
        raise ProtocolError(f"sample: {len(header.names)} names, {len(header.dtypes)} dtypes")
    if len(header.names) > _MOST_ARRAYS or len(set(header.names)) != len(header.names):
        raise LimitExceeded(f"sample: arrays {list(header.names)!r:.200}; at most {_MOST_ARRAYS}, no name twice")
    layout: dict[str, tuple[str, tuple[int, ...]]] = {}
    rest = list(header.shapes)
    for name, dtype in zip(header.names, header.dtypes, strict=True):
        if dtype not in ARRAY_DTYPES:
            raise ProtocolError(
                f"sample: array {name!r:.40} of dtype {dtype!r:.40}; allowed: {', '.join(ARRAY_DTYPES)}"
            )
        ndim = rest.pop(0) if rest else 0
        shape, rest = tuple(rest[:ndim]), rest[ndim:]
        if len(shape) != ndim or not 0 < ndim <= _MOST_DIMENSIONS or 0 in shape:
            raise ProtocolError(f"sample: array {name!r:.40} has no complete shape of extents from 1")
        size = math.prod(shape) * np.dtype(dtype).itemsize
        if size > LARGEST_ARRAY_BYTES:
            raise LimitExceeded(f"sample: array {name!r:.40} of {size} bytes; the limit is {LARGEST_ARRAY_BYTES}")
        layout[name] = (dtype, shape)
    if rest:
        raise ProtocolError(f"sample: {len(rest)} extents belong to no array")
    return layout


def _unpacked(packed: Buffer, what: str) -> Any:
    containers = 0

    def count(container: Any) -> Any:
        nonlocal containers
        containers += 1
        if containers > MOST_CONTAINERS:
            raise LimitExceeded(f"more than {MOST_CONTAINERS} lists and maps")
        return container

    try:
        return msgpack.unpackb(
            packed, raw=False, strict_map_key=True, use_list=True, list_hook=count, object_hook=count
        )
    except (ValueError, msgpack.exceptions.UnpackException) as error:
        # msgpack's own errors quote raw bytes; the kind of damage is enough.
        raise ProtocolError(f"not {what}: {type(error).__name__}") from error
