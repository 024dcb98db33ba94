"""The messages, as frozen dataclasses. How they become bytes is :mod:`v2v_protocol.wire`; who may send what when is
`docs/protocol.md`.

    consumer -> server     Hello, Want, Ping, Goodbye
    server -> consumer     Welcome, SampleHeader (+ one raw frame per array), Unavailable, Denied, Pong
    worker -> server       WorkerHello, Begun, Result (+ a whole SampleHeader message), LeaseFailed, Ping, Goodbye
    server -> worker       Lease, Stop, Denied, Pong
    anybody -> server      See
    server -> anybody      Seen

Field types are the few that the wire checks: int (0 .. 2**64 - 1), float, bool, str, bytes, int | None, tuples of int,
float or str, and Mapping (plain values, checked by whoever knows its form).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any


class ErrorCode(StrEnum):
    """Why the server denied a request."""

    VERSION = "version"
    MALFORMED = "malformed"
    SPEC = "spec"
    UNKNOWN_SESSION = "unknown-session"
    CREDIT = "credit"
    RANGE = "range"
    BUSY = "busy"


# --- consumer -> server -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Hello:
    """Opens (or opens again, after a server restart) a consumer's session.

    Attributes:
        spec: what the consumer asks for, see ``StreamSpec.from_dict``; missing fields take the server's defaults.
        arrays: names of the arrays wanted.
        batch_size: samples of a batch; it only sizes the suggested credit.
        seed: seed of the stream.
        quarantine: number of the quarantine snapshot to go on under; None: the newest.
        stride: samples from the beginning of one batch of this consumer to that of its next: batch size x ranks x
            loader workers. It settles a ``sibling_spacing`` that the spec leaves open; 0: the batch size.
        name, host: what people shall read of this consumer, "rank 0 of 2" on "gpu-1" for instance.
        packed: whether it asks for compressed arrays, because a network lies between. It must take both.
        secret: random bytes that own the session, at most 64. A Hello with the same secret, and the same key if there
            are keys, takes the session over to its own connection. It is never published. Without one, a consumer
            that connects again gets a new session.
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
class Want:
    """Asks for samples of one epoch; each index is one unit of credit spent until it is answered.

    An index that is asked for again while it is in work is not made twice.

    Attributes:
        epoch, indices: which samples.
        arenas, slots: for each index, memory that a worker of the same host may put its sample into, see
            :mod:`v2v_protocol.arena`; "" and 0 where there is none. Empty: none for any.
        waited_seconds: for how long the consumer has waited for samples in all since its Hello. For people to read;
            nothing goes by it.
    """

    epoch: int
    indices: tuple[int, ...]
    arenas: tuple[str, ...] = ()
    slots: tuple[int, ...] = ()
    waited_seconds: float = 0.0


@dataclass(frozen=True, slots=True)
class Ping:
    """Is anybody there? Sent when nothing else was, so that any traffic counts as life."""


@dataclass(frozen=True, slots=True)
class Goodbye:
    """The sender leaves in peace: forget its session, or give its leases to others.

    Attributes:
        waited_seconds: of a consumer, as :class:`Want` says it.
    """

    waited_seconds: float = 0.0


@dataclass(frozen=True, slots=True)
class See:
    """Asks for the state of the service. Needs no session, and may be said on the workers' side too. The answer is the
    next state that is made, a few times a second; several before it get one answer."""


# --- server -> consumer -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Welcome:
    """Answers Hello.

    Attributes:
        spec: the resolved spec, every field present.
        spec_digest, catalogue_digest, numerics_version: the server's half of every sample's identity.
        sequences: N, samples of one epoch before ranks drop a remainder.
        credit: samples the consumer may have asked for and not yet received, at most.
        quarantine: number of the quarantine snapshot its samples are made under, until a new verdict falls.
    """

    spec: Mapping[str, Any]
    spec_digest: str
    catalogue_digest: str
    numerics_version: int
    sequences: int
    credit: int
    quarantine: int = 0


@dataclass(frozen=True, slots=True)
class SampleHeader:
    """One sample; the raw bytes of each array follow as frames of their own, C order, little endian.

    With ``slot`` set and no frames behind it, the arrays lie in that slot, one after the other.

    Attributes:
        epoch, index: which sample.
        names, dtypes: of the arrays, in the order of the raw frames.
        shapes: of all arrays, flattened: ndim, extents, ndim, extents ...
        provenance: ``Provenance.to_dict()`` as :func:`v2v_protocol.wire.encode_map` encodes it, so that a server need
            not open it.
        worker: name of the server worker that made it.
        cpu_seconds: processor time it took there.
        decoded: whether a clip was decoded for it, or read; False where it came from that of a sibling.
        cache: "hit" or "miss" where its worker has a cache, "miss: " and a reason where that can keep no more; else "".
        slot: the slot that the lease named, to which this worker writes no more; 0: it named none.
        quarantine: number of the quarantine snapshot that the lease named, as the provenance says it.
        packed: the raw frames are zstd frames, one for each array.
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


@dataclass(frozen=True, slots=True)
class Unavailable:
    """One asked sample cannot be made from any of its candidates; ``text`` says what each of them lacked."""

    epoch: int
    index: int
    text: str


@dataclass(frozen=True, slots=True)
class Denied:
    """A request cannot be granted. ``code`` is an ErrorCode; ``text`` says what to do about it."""

    code: str
    text: str


@dataclass(frozen=True, slots=True)
class Pong:
    """Answers Ping.

    Attributes:
        trouble: why nobody can make a sample now, and what to do about it; empty where somebody can.
    """

    trouble: str = ""


@dataclass(frozen=True, slots=True)
class Seen:
    """Answers See.

    Attributes:
        json: ``v2v_server.console.state.ServiceState.to_dict()`` as JSON, UTF-8.
    """

    json: bytes


# --- worker -> server -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class WorkerHello:
    """Offer a worker, with room for ``credit`` leases at a time.

    Attributes:
        name: of the worker; no other connected worker may have it.
        numerics_version: of the samples that it makes.
        credit: leases that it takes at a time.
        host: for people to read.
        secret: random bytes that own the name, at most 64. A hello with the same secret, and the same key if there are
            keys, replaces the connection before. It is never published.
    """

    name: str
    numerics_version: int
    credit: int
    host: str = ""
    secret: bytes = b""


@dataclass(frozen=True, slots=True)
class Begun:
    """The worker starts on this lease now: only a lease that was begun can be blamed for what happens next."""

    lease: int


@dataclass(frozen=True, slots=True)
class Result:
    """A lease's sample is done; the frames of its SampleHeader message follow, to be passed on as they are.

    Attributes:
        lease: number of the lease.
        begins: number of the lease that the worker starts on next, as :class:`Begun` says it; 0: it has none at hand.
        decode_seconds: that its clip took to be decoded, or read; 0 where that of a sibling was at hand.
        simulate_seconds: from the clip to the arrays.
        handover_seconds: of finding the sample's memory, and of packing and sending the one before.
        memory_bytes: of the worker's process; 0: not known.

    The last four are for people to read; nothing goes by them.
    """

    lease: int
    begins: int = 0
    decode_seconds: float = 0.0
    simulate_seconds: float = 0.0
    handover_seconds: float = 0.0
    memory_bytes: int = 0


@dataclass(frozen=True, slots=True)
class LeaseFailed:
    """The lease's video could not give what it promised. ``frame`` and ``reason`` are those of VideoError.

    Attributes:
        here: the worker's host cannot read the file, or has another one in its place, which says nothing of the video.
    """

    lease: int
    frame: int | None
    reason: str
    here: bool = False


# --- server -> worker -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Lease:
    """One clip of one video, and the sample to be made from it.

    Attributes:
        lease: number of the lease.
        spec: canonical bytes of the StreamSpec.
        spec_digest, catalogue_digest: of the identity of its samples.
        seed, epoch: of the identity of its samples.
        indices: first the sample to be made; then its siblings, which are made from the same clip and follow in leases
            of their own, if nothing comes in between: a worker that decodes for all of them at once decodes once.
        arrays: names of the arrays to send.
        video: catalogue id; the worker finds the file below its own root.
        fingerprint: what the file must still be.
        rows: rows of the picture that may be used, ``Rows`` syntax.
        width_px, height_px: of the upright picture, before rows.
        frames_per_second: average rate, for noise stated per second; 0 where unknown.
        thresholds: (positive, negative) when the corpus states them for this video, else empty.
        start_frame: first frame of the sequence.
        frame_index: ``FrameIndex.to_bytes()`` of at least the part of the file that is needed.
        candidate: which candidate of the index this is.
        refusals: candidates passed over before, as ``Refusal.to_dict()`` says them: {"refusals": [...]}.
        quarantine: number of the quarantine snapshot that let the candidate pass.
        scene: ``Scene.to_bytes()`` of the part of the video that is needed; empty where the spec asks for none.
        arena, slot: where the sample may be put, see :mod:`v2v_protocol.arena`; "" and 0: in the message only.
        packed: whether arrays that go into the message are to be compressed.
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


@dataclass(frozen=True, slots=True)
class Stop:
    """Finish what was begun, say Goodbye and exit."""


Message = (
    Hello | Want | Ping | Goodbye | Welcome | SampleHeader | Unavailable | Denied | Pong | See | Seen
    | WorkerHello | Begun | Result | LeaseFailed | Lease | Stop
)  # fmt: skip
