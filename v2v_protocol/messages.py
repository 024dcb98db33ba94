"""The messages, as frozen dataclasses. :mod:`v2v_protocol.wire` encodes them; `docs/protocol.md` states which peer may
send which message when.

    consumer -> server     Hello, Want, Ping, Goodbye
    server -> consumer     Welcome, SampleHeader (+ one raw frame per array), Unavailable, Denied, Pong
    worker -> server       WorkerHello, Begun, Result (+ a whole SampleHeader message), LeaseFailed, Ping, Goodbye
    server -> worker       Lease, Stop, Denied, Pong
    any peer -> server     GetStatus
    server -> any peer     Status

A message is checked by the types of its fields (:mod:`v2v_protocol.persisted`); the plain values of a Mapping are
checked by the code that uses them. Fields that are ``later`` were added within a protocol version.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from v2v_protocol.persisted import Persisted, later


class ErrorCode(StrEnum):
    """Reason why the server denied a request."""

    VERSION = "version"
    MALFORMED = "malformed"
    SPEC = "spec"
    UNKNOWN_SESSION = "unknown-session"
    CREDIT = "credit"
    RANGE = "range"
    BUSY = "busy"


# --- consumer -> server -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Hello(Persisted):
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
class Want(Persisted):
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
class Ping(Persisted):
    """Ask for a sign of life. It is sent only after a silence, because any message counts as a sign of life."""


@dataclass(frozen=True, slots=True)
class Goodbye(Persisted):
    """The sender leaves in an orderly way: forget its session, or give its leases to other workers.

    Attributes:
        waited_seconds: of a consumer, as in :class:`Want`.
    """

    waited_seconds: float = 0.0


@dataclass(frozen=True, slots=True)
class GetStatus(Persisted):
    """Ask for the state of the service. It needs no session, and workers' ports accept it too. The answer is the next
    state that is built, a few times a second; several requests before it get one answer.
    """


# --- server -> consumer -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Welcome(Persisted):
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
class SampleHeader(Persisted):
    """One sample; the raw bytes of each array follow as frames of their own, C order, little endian.

    If ``slot`` is set and no frames follow, the arrays lie in that slot, one after the other. If ``arena`` is set as
    well, they lie in that arena of the server instead, which has one slot and whose content is sealed.

    Attributes:
        epoch, index: which sample.
        names, dtypes: of the arrays, in the order of the raw frames.
        shapes: of all arrays, flattened: ndim, extents, ndim, extents ...
        provenance: ``Provenance.to_dict()``, encoded by :func:`v2v_protocol.wire.encode_map`, so that a server need not
            decode it.
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
class Unavailable(Persisted):
    """A requested sample cannot be made from any of its candidates; ``text`` lists the reason of each."""

    epoch: int
    index: int
    text: str


@dataclass(frozen=True, slots=True)
class Denied(Persisted):
    """A request cannot be granted. ``code`` is an ErrorCode; ``text`` says what to do about it."""

    code: str
    text: str


@dataclass(frozen=True, slots=True)
class Pong(Persisted):
    """Answer to Ping.

    Attributes:
        trouble: why no worker can make a sample now, and what to do about it; empty if one can.
    """

    trouble: str = ""


@dataclass(frozen=True, slots=True)
class Status(Persisted):
    """Answer to GetStatus.

    Attributes:
        json: a status as JSON, UTF-8; see :mod:`v2v_server.status.parts`.
    """

    json: bytes


# --- worker -> server -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class WorkerHello(Persisted):
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
class Begun(Persisted):
    """The worker starts on this lease now. Only a lease that was begun can be blamed for what happens next."""

    lease: int


@dataclass(frozen=True, slots=True)
class Result(Persisted):
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
class LeaseFailed(Persisted):
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
class Lease(Persisted):
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
        remark: what of the video is not served, or served with wrong grey levels; goes into the provenance.
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
class Stop(Persisted):
    """Finish what was begun, say Goodbye and exit."""


Message = (
    Hello | Want | Ping | Goodbye | Welcome | SampleHeader | Unavailable | Denied | Pong | GetStatus | Status
    | WorkerHello | Begun | Result | LeaseFailed | Lease | Stop
)  # fmt: skip
