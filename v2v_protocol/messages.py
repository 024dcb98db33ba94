"""The messages, as frozen dataclasses, and their bytes; `docs/protocol.md` states which peer may send which when.

    consumer -> server     Hello, Want, Ping, Goodbye
    server -> consumer     Welcome, SampleHeader (+ one raw frame per array), Unavailable, Denied, Pong
    worker -> server       WorkerHello, Begun, Result (+ a whole SampleHeader message), LeaseFailed, Ping, Goodbye
    server -> worker       Lease, Stop, Denied, Pong
    any peer -> server     GetStatus
    server -> any peer     Status

A message is sent as the frames of a ZeroMQ multipart message. Frame 0 is a msgpack map: ``{"v": protocol version, "t":
type name, ...fields}``. A SampleHeader is followed by one raw frame per array; a Result by the frames of a whole
SampleHeader message, which a broker passes on unchanged.

All received data is treated as hostile: sizes are limited before anything is allocated, fields are checked by their
types (:mod:`v2v_protocol.persisted`; the code that uses a Mapping checks the plain values in it), dtypes come from an
allow-list, and nothing is ever unpickled. For any bytes, :func:`decode` either returns a message or raises a
:class:`v2v_protocol.errors.ProtocolError`.

Messages grow within a protocol version. What a receiver may ignore is added to :class:`Notes`. What it must heed, such
as all that changes a sample, is a new field that is ``later``: a receiver that does not know it refuses the message.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from enum import StrEnum
from typing import Any, TypeAlias

import msgpack
import numpy as np
import numpy.typing as npt

from v2v_protocol import PROTOCOL_VERSION
from v2v_protocol.arena import NO_SLOT
from v2v_protocol.errors import LimitExceeded, ProtocolError, VersionMismatch
from v2v_protocol.persisted import Persisted, add_fields, later, read_fields, reader, shown
from v2v_protocol.sample import Layout


class ErrorCode(StrEnum):
    """Reason why the server denied a request."""

    VERSION = "version"
    MALFORMED = "malformed"
    SPEC = "spec"
    UNKNOWN_SESSION = "unknown-session"
    CREDIT = "credit"
    RANGE = "range"
    BUSY = "busy"


@dataclass(frozen=True, slots=True)
class Notes(Persisted):
    """What a message says for information. A receiver drops names that it does not know, so no note changes a sample.

    Attributes:
        memory_bytes: of a WorkerHello: limit of the worker's memory; 0: not known.
        reason: of a Goodbye: why a worker cannot work for this server; "": it just leaves.
        state: of a Lease: numbers that the file's size and times had when it was catalogued. A worker whose file has
            them need not read all of it; empty: not known.
        credit: of a worker's Ping: leases that it takes at a time from now on; 0: no change.
        catalogue, spec: of a Pong to a worker: digests of the catalogue and of the spec that consumers get by default.
    """

    memory_bytes: int = later(0)
    reason: str = later("")
    state: tuple[int, ...] = later(())
    credit: int = later(0)
    catalogue: str = later("")
    spec: str = later("")

    @classmethod
    def from_dict(cls, values: Any) -> Notes:
        """Return the notes that this release knows.

        Raises:
            ProtocolError: they are not a map, or a known one has a value of another type.
        """
        is_map = isinstance(values, dict)
        return read_fields(cls, {each: values[each] for each in cls.__slots__ if each in values} if is_map else values)


@dataclass(frozen=True, slots=True)
class Noted(Persisted):
    """Base of all messages.

    Attributes:
        notes: what the receiver may ignore.
    """

    _: KW_ONLY
    notes: Notes = later(default_factory=Notes)


# --- consumer -> server -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Hello(Noted):
    """Open a consumer's session, or open it again after a server restart.

    Attributes:
        spec: requested fields, see ``StreamSpec.from_dict``; missing fields take the server's defaults.
        arrays: names of the requested arrays.
        batch_size: samples of a batch; it only sets the suggested credit.
        seed: seed of the stream.
        quarantine: number of the quarantine snapshot to use; None: the newest.
        stride: samples from the beginning of one batch of this consumer to that of its next: batch size x ranks x
            loader workers. It sets a ``sibling_spacing`` that the spec leaves open; 0: the batch size.
        name, host: display names of this consumer, for instance "rank 0 of 2" on "gpu-1".
        packed: whether it asks for compressed arrays, because the connection is a network. It must accept both forms.
        secret: random bytes that own the session, at most 64. A Hello with the same secret, and the same key if there
            are keys, takes the session over to its own connection. It is never published. Without a secret, a consumer
            that reconnects gets a new session.
    """

    spec: Mapping[str, Any]
    arrays: tuple[str, ...]
    batch_size: int
    seed: int
    quarantine: int | None = None
    stride: int = 0
    name: str = ""
    host: str = ""
    packed: bool = False
    secret: bytes = b""


@dataclass(frozen=True, slots=True)
class Want(Noted):
    """Ask for samples of one epoch; each index uses one unit of credit until it is answered.

    An index that is requested again while it is in work is not made twice.

    Attributes:
        epoch, indices: which samples.
        arenas, slots: for each index, memory that a worker of the same host may write its sample to, see
            :mod:`v2v_protocol.arena`; "" and 0 for an index without a slot. Empty: no index has a slot.
        waited_seconds: total time that the consumer has waited for samples since its Hello. For display only.
    """

    epoch: int
    indices: tuple[int, ...]
    arenas: tuple[str, ...] = ()
    slots: tuple[int, ...] = ()
    waited_seconds: float = 0.0


@dataclass(frozen=True, slots=True)
class Ping(Noted):
    """Ask for a sign of life. It is sent only after a silence, because any message counts as a sign of life."""


@dataclass(frozen=True, slots=True)
class Goodbye(Noted):
    """The sender leaves in an orderly way: forget its session, or give its leases to other workers.

    Attributes:
        waited_seconds: of a consumer, as in :class:`Want`.
    """

    waited_seconds: float = 0.0


@dataclass(frozen=True, slots=True)
class GetStatus(Noted):
    """Ask for the state of the service. It needs no session, and workers' ports accept it too. The answer is the next
    state that is built, a few times a second; several requests before it get one answer.
    """


# --- server -> consumer -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Welcome(Noted):
    """Answer to Hello.

    Attributes:
        spec: the resolved spec, with every field.
        spec_digest, catalogue_digest, numerics_version: the server's part of every sample's identity.
        sequences: N, samples of one epoch before ranks drop a remainder.
        credit: largest number of samples that the consumer may have requested and not yet received.
        quarantine: number of the quarantine snapshot that its samples are made under, until a new entry is written.
        sidecars: names the files beside the videos that the requested arrays are made from; "" if there are none.
    """

    spec: Mapping[str, Any]
    spec_digest: str
    catalogue_digest: str
    numerics_version: int
    sequences: int
    credit: int
    quarantine: int = 0
    sidecars: str = later("")


@dataclass(frozen=True, slots=True)
class SampleHeader(Noted):
    """One sample; the raw bytes of each array follow as frames of their own, C order, little endian.

    If ``slot`` is set and no frames follow, the arrays lie in that slot, one after the other. If ``arena`` is set as
    well, they lie in that arena of the server instead, which has one slot and whose content is sealed.

    Attributes:
        epoch, index: which sample.
        names, dtypes: of the arrays, in the order of the raw frames.
        shapes: of all arrays, flattened: ndim, extents, ndim, extents ...
        provenance: ``Provenance.to_dict()``, encoded by :func:`encode_map`, so that a server need not decode it.
        worker: name of the server worker that made it.
        cpu_seconds: processor time that it took there.
        decoded: whether its clip was decoded or read; False if it came from a sibling.
        cache: "hit" or "miss" if its worker has a cache, "miss: " and a reason if the cache stores nothing more;
            otherwise "".
        slot: the slot that the lease named, to which this worker no longer writes; 0: the lease named no slot.
        quarantine: number of the quarantine snapshot that the lease named, as in the provenance.
        packed: the raw frames are zstd frames, one for each array.
        arena: name of the server's memory that holds the arrays; "": they lie in the slot, or follow.
    """

    epoch: int
    index: int
    names: tuple[str, ...]
    dtypes: tuple[str, ...]
    shapes: tuple[int, ...]
    provenance: bytes
    worker: str
    cpu_seconds: float
    decoded: bool = True
    cache: str = ""
    slot: int = 0
    quarantine: int = 0
    packed: bool = False
    arena: str = later("")


@dataclass(frozen=True, slots=True)
class Unavailable(Noted):
    """A requested sample cannot be made from any of its candidates; ``text`` lists the reason of each."""

    epoch: int
    index: int
    text: str


@dataclass(frozen=True, slots=True)
class Denied(Noted):
    """A request cannot be granted. ``code`` is an ErrorCode; ``text`` says what to do about it."""

    code: str
    text: str


@dataclass(frozen=True, slots=True)
class Pong(Noted):
    """Answer to Ping.

    Attributes:
        trouble: why no worker can make a sample now, and what to do about it; empty if one can.
    """

    trouble: str = ""


@dataclass(frozen=True, slots=True)
class Status(Noted):
    """Answer to GetStatus.

    Attributes:
        json: a status as JSON, UTF-8; see :mod:`v2v_server.status.snapshot`.
    """

    json: bytes


# --- worker -> server -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class WorkerHello(Noted):
    """Offer a worker that accepts ``credit`` leases at a time.

    Attributes:
        name: of the worker; no other connected worker may have it.
        numerics_version: of the samples that it makes.
        credit: leases that it takes at a time.
        host: for display.
        secret: random bytes that own the name, at most 64. A hello with the same secret, and the same key if there are
            keys, replaces the connection before. It is never published.
    """

    name: str
    numerics_version: int
    credit: int
    host: str = ""
    secret: bytes = b""


@dataclass(frozen=True, slots=True)
class Begun(Noted):
    """The worker starts on this lease now. Only a lease that was begun can be blamed for what happens next."""

    lease: int


@dataclass(frozen=True, slots=True)
class Result(Noted):
    """A lease's sample is done; the frames of its SampleHeader message follow, and are passed on unchanged.

    Attributes:
        lease: number of the lease.
        begins: number of the lease that the worker starts on next, as in :class:`Begun`; 0: it has no lease.
        decode_seconds: time to decode or read its clip; 0 if a sibling's clip was available.
        simulate_seconds: time from the clip to the arrays.
        handover_seconds: time to find the sample's memory, and to pack and send the previous sample.
        memory_bytes: memory of the worker's process; 0: not known.

    The last four are for display only.
    """

    lease: int
    begins: int = 0
    decode_seconds: float = 0.0
    simulate_seconds: float = 0.0
    handover_seconds: float = 0.0
    memory_bytes: int = 0


@dataclass(frozen=True, slots=True)
class LeaseFailed(Noted):
    """The lease's video could not be used. ``frame`` and ``reason`` are those of VideoError.

    Attributes:
        here: the worker's host cannot read the file, or has another one in its place; the video may be sound elsewhere.
        sidecar: ending of the sidecar that failed, not the video; "" if the video failed.
    """

    lease: int
    frame: int | None
    reason: str
    here: bool = False
    sidecar: str = later("")


# --- server -> worker -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Lease(Noted):
    """One clip of one video, and the sample to make from it.

    Attributes:
        lease: number of the lease.
        spec: canonical bytes of the StreamSpec.
        spec_digest, catalogue_digest: parts of the identity of its samples.
        seed, epoch: parts of the identity of its samples.
        indices: the sample to make, then its siblings, which are made from the same clip and follow in leases of their
            own if nothing intervenes. A worker that decodes for all of them decodes once.
        arrays: names of the arrays to send.
        video: catalogue id; the worker finds the file below its own root.
        fingerprint: expected fingerprint of the file.
        rows: usable rows of the picture, ``Rows`` syntax.
        width_px, height_px: of the upright picture, before rows.
        frames_per_second: average rate, for noise stated per second; 0 if unknown.
        thresholds: (positive, negative) if the corpus states them for this video, otherwise empty.
        start_frame: first frame of the sequence.
        frame_index: ``FrameIndex.to_bytes()`` of at least the needed part of the file.
        candidate: number of the candidate of the index, from 0.
        refusals: refusals of earlier candidates, as ``Refusal.to_dict()``: {"refusals": [...]}.
        quarantine: number of the quarantine snapshot under which the candidate was chosen.
        scene: ``Scene.to_bytes()`` of the needed part of the video; empty if the spec does not use scenes.
        arena, slot: memory that the sample may be written to, see :mod:`v2v_protocol.arena`; "" and 0: none.
        packed: whether to compress arrays that go into the message.
        sidecars: fingerprints of the video's sidecars that the arrays are made from, by ending; a missing one is left
            out. To workers it may be [fingerprint, part]: bytes, the table of the files of a folder that the clip
            needs; or a text, why the sidecar is not used, perhaps without a fingerprint.
        remark: what of the video is not served, or served with wrong grey levels or times; goes into the provenance.
    """

    lease: int
    spec: bytes
    spec_digest: str
    catalogue_digest: str
    seed: int
    epoch: int
    indices: tuple[int, ...]
    arrays: tuple[str, ...]
    video: str
    fingerprint: str
    rows: str
    width_px: int
    height_px: int
    frames_per_second: float
    thresholds: tuple[float, ...]
    start_frame: int
    frame_index: bytes
    candidate: int
    refusals: Mapping[str, Any]
    quarantine: int = 0
    scene: bytes = b""
    arena: str = ""
    slot: int = 0
    packed: bool = False
    sidecars: Mapping[str, Any] = later(default_factory=dict)
    remark: str = later("")


@dataclass(frozen=True, slots=True)
class Stop(Noted):
    """Finish what was begun, say Goodbye and exit."""


Message = (
    Hello | Want | Ping | Goodbye | Welcome | SampleHeader | Unavailable | Denied | Pong | GetStatus | Status
    | WorkerHello | Begun | Result | LeaseFailed | Lease | Stop
)  # fmt: skip


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
_plain_map: Callable[[Any], dict[str, Any]] = reader(Mapping[str, Any])


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
        arrays: of the sample, such as voxels [T, bins, H, W].
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
    layout: Layout, payload: Sequence[Buffer], unpack: Callable[[Buffer, int], Buffer] | None = None
) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays of a sample whose header states this layout, such as voxels [T, bins, H, W].

    They are views of the payload (read-only).

    Args:
        layout: dtype and shape of each array.
        payload: the raw frames behind the header.
        unpack: of a packed sample: takes an array's frame and its number of bytes, and returns these bytes; it raises
            ProtocolError for any other content.

    Raises:
        ProtocolError: the frames do not have the number and the sizes of the arrays.
    """
    if len(layout) != len(payload):
        raise ProtocolError(f"sample: {len(payload)} raw frames for {len(layout)} arrays")
    arrays: dict[str, npt.NDArray[Any]] = {}
    for (name, (dtype, shape)), raw in zip(layout.items(), payload, strict=True):
        size = math.prod(shape) * np.dtype(dtype).itemsize
        raw = raw if unpack is None else unpack(raw, size)
        if size != len(raw):
            raise ProtocolError(f"sample: array {name} {dtype}{list(shape)} is {size} bytes, got {len(raw)}")
        array = np.frombuffer(raw, dtype=np.dtype(dtype)).reshape(shape)
        array.flags.writeable = False
        arrays[name] = array
    return arrays


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
