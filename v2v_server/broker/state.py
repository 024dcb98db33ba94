"""What the broker knows, as one value, and the actions that it wants done. No I/O: the loop (:mod:`v2v_server.serve`)
has the sockets, the processes and the disk, and does them. The modules of this folder change the value; all others only
read it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any, TypeAlias

from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.errors import ProtocolError, VersionMismatch
from v2v_protocol.messages import Denied, ErrorCode, Frames, Lease, Notes, encode
from v2v_protocol.sample import Refusal, SampleId
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.leases import LeaseBook, Request, WorkDone, Workers
from v2v_server.broker.session import Sessions
from v2v_server.corpus.videos import CorpusFacts
from v2v_server.quarantine import Quarantine, QuarantineEntry
from v2v_server.schedule import Columns, SequenceTable
from v2v_server.sharing import SampleRing
from v2v_server.system.log import counter, meanings, short, text

_LONGEST_TEXT = 2000
"""Characters of a denial. It quotes what the peer sent, which may be long, and must fit a header."""
MOST_LATEST = 20
"""Number of refusals kept for the status."""
_LONGEST_TROUBLE = 120


@dataclass(frozen=True, slots=True)
class ToConsumer:
    """Send these frames to a consumer."""

    identity: bytes
    frames: Sequence[Any]


@dataclass(frozen=True, slots=True)
class ToWorker:
    """Send these frames to a worker.

    Attributes:
        identity: routing id.
        frames: the message.
        arena: arena of the lease that it is, which is passed to the worker before.
    """

    identity: bytes
    frames: Frames
    arena: str = ""


@dataclass(frozen=True, slots=True)
class Grant:
    """Complete the leases of one clip with what the index on disk holds of it, and send them to a worker; or report
    that they cannot be completed.

    Attributes:
        identity: routing id of the worker.
        leases: without the parts that the index holds; those behind the first are its siblings.
        spec: the spec that the leases name.
        takes_notes: whether the worker accepts a message with notes.
    """

    identity: bytes
    leases: tuple[Lease, ...]
    spec: StreamSpec
    takes_notes: bool

    def messages(self, first: Lease) -> list[ToWorker]:
        """Return the messages to the worker.

        Args:
            first: the first lease, completed; its siblings take the same parts of the index.
        """
        first = first if self.takes_notes else replace(first, notes=Notes())
        parts = {name: getattr(first, name) for name in ("frame_index", "scene", "sidecars", "notes")}
        completed = [first, *(replace(sibling, **parts) for sibling in self.leases[1:])]
        return [ToWorker(self.identity, encode(lease), lease.arena) for lease in completed]


@dataclass(frozen=True, slots=True)
class Disconnect:
    """Disconnect a consumer that keeps sending malformed messages."""

    identity: bytes


@dataclass(frozen=True, slots=True)
class GiveUp:
    """End a hung worker's process, if it is one of ours, and report its loss."""

    identity: bytes
    reason: str


@dataclass(frozen=True, slots=True)
class AddToQuarantine:
    """Write this entry before any later action is carried out, and report the result.

    Attributes:
        entry: not numbered yet.
        request: the request whose candidate it refuses.
    """

    entry: QuarantineEntry
    request: Request


@dataclass(frozen=True, slots=True)
class CheckVideo:
    """Check whether this host has a video (or its sidecar) as catalogued, because a worker cannot read it on its host.

    Attributes:
        video, fingerprint: of the file.
        identity: routing id of the worker.
        frame, reason: what the worker reported.
        request: the request that it could not make.
        sidecar: ending of the video's sidecar that is meant, with its fingerprint; "": the video itself.
    """

    video: str
    fingerprint: str
    identity: bytes
    frame: int | None
    reason: str
    request: Request
    sidecar: str = ""


@dataclass(frozen=True, slots=True)
class ReportRefusal:
    """Tell the operator that a video was passed over.

    Attributes:
        refusal: which video, and why.
        request: the request that it was passed over for.
    """

    refusal: Refusal
    request: Request | None = None


@dataclass(frozen=True, slots=True)
class SendStatus:
    """Send the next state of the service to this peer.

    Attributes:
        identity: routing id of the peer.
        is_worker_side: whether it is connected to the workers' port.
    """

    identity: bytes
    is_worker_side: bool = False


Action: TypeAlias = (
    ToConsumer | ToWorker | Grant | Disconnect | GiveUp | AddToQuarantine | CheckVideo | ReportRefusal | SendStatus
)


def denial(code: ErrorCode, text: str) -> Frames:
    """Build a Denied message, shortened to fit a header."""
    return encode(Denied(code, text if len(text) <= _LONGEST_TEXT else text[:_LONGEST_TEXT] + " ..."))


@dataclass(slots=True)
class Counters(WorkDone):
    """Totals since the start. The status leaves out fields without a meaning text."""

    samples: int = counter("Samples sent to consumers.", is_routine=True)
    batches: float = counter("Batches sent to consumers, in each consumer's own batch size.", is_routine=True)
    decodes: int = counter("Clips decoded for the samples sent; siblings share one.", is_routine=True)
    bytes: int = counter("Bytes of the arrays of the samples sent.", "sample_bytes", unit="bytes", is_routine=True)
    in_slots: int = counter(
        "Samples delivered in memory shared with their consumer.", "shared_memory_samples", is_routine=True
    )
    shared: int = counter("Samples that were made for another consumer already.", "shared_samples", is_routine=True)
    cpu_seconds: float = counter(
        "Processor time that samples took in workers.", "worker_cpu_seconds", unit="s", is_routine=True
    )
    decode_seconds: float = counter(
        "Wall-clock time of workers, decoding.", "worker_seconds", unit="s", part="decode", is_routine=True
    )
    simulate_seconds: float = counter(
        "Wall-clock time of workers, simulating.", "worker_seconds", unit="s", part="simulate", is_routine=True
    )
    handover_seconds: float = counter(
        "Wall-clock time of workers, delivering.", "worker_seconds", unit="s", part="handover", is_routine=True
    )
    queued_seconds: float = counter(
        "Time that the server's own workers waited for a core.", "worker_queued_seconds", unit="s", is_routine=True
    )
    waited_seconds: float = counter(
        "Time that consumers waited for samples, as they report.", "consumer_waiting_seconds", unit="s", is_routine=True
    )
    refused_candidates: int = counter("Candidates skipped because their video could not be used.", is_fault=True)
    unavailable: int = counter("Samples without a usable candidate.", "unavailable_samples", is_fault=True)
    returned_leases: int = counter("Leases taken back from workers that died, hung or left.")
    second_leases: int = counter("Samples given to a second worker because the first was slow.", is_routine=True)
    late_results: int = counter(
        "Results of leases that had been taken back, or whose consumer had left.", is_routine=True
    )
    workers_lost: int = counter("Workers that died or were given up.", "lost_workers", is_fault=True)
    missing_videos: int = counter(
        "Leases whose worker could not read a video that the server's host has.", is_fault=True
    )
    malformed: int = counter("Malformed messages received.", "malformed_messages", is_fault=True)
    cache_hits: int = 0
    cache_misses: int = 0
    cache_trouble: str = ""

    def count_sent(self, batch_size: int, sizes: Sequence[int], *, in_slot: bool) -> None:
        """Count a sample that is sent.

        Args:
            batch_size: of its consumer.
            sizes: bytes of each array.
            in_slot: whether its arrays are not in the message.
        """
        self.batches += 1 / batch_size
        self.bytes += sum(sizes)
        self.in_slots += in_slot

    def count_cache(self, said: str) -> None:
        """Count the cache field of a sample's header."""
        kind, _, trouble = said.partition(": ")
        self.cache_hits += kind == "hit"
        self.cache_misses += kind == "miss"
        if kind == "miss":
            self.cache_trouble = "".join(filter(str.isprintable, trouble))[:_LONGEST_TROUBLE]

    @property
    def faults(self) -> int:
        """Return the number of faults that the service survived."""
        return sum(getattr(self, name) for name, meaning in meanings(Counters).items() if meaning.is_fault)


@dataclass(frozen=True, slots=True)
class FaultTotal:
    """Sum of the counters that are faults."""

    faults: int = counter("Faults that the service survived, in total.", is_routine=True)


@dataclass(frozen=True, slots=True)
class RefusalPart:
    """One of the last skipped candidates, newest first."""

    time: str = text("Time, ISO 8601, UTC.")
    video: str = text("Catalogue id of the video.")
    frame: int | None = text("First frame; null if it is the whole video.")
    reason: str = text("Why it was skipped.")
    kind: str = text("Kind of refusal: failed, quarantined and others.")

    @classmethod
    def of(cls, refusal: Refusal, time: str) -> RefusalPart:
        """Describe a refusal, with the time of day, ISO 8601."""
        return cls(time, short(refusal.video), refusal.frame, short(refusal.reason), str(refusal.kind))


@dataclass(slots=True)
class ParkedClip:
    """Requests of one clip that wait for a worker with enough memory, or alone for a worker without leases.

    Attributes:
        needs_bytes: memory that the worker must have.
        requests: the request, and its siblings.
        since: when a connected worker last had that much, or when it was parked.
        trouble: that no connected worker has; empty if one has.
    """

    needs_bytes: int
    requests: list[Request]
    since: float
    trouble: str = ""


@dataclass(eq=False)
class Broker:
    """Consumers, workers, and what passes between them.

    Attributes:
        facts: what is known of the videos, in memory.
        default_spec: the spec of a consumer that sends none.
        lease_deadline_seconds: a worker that is silent over one sample for longer than this, in addition to the time
            that the sample may take, is treated as hung.
        session_idle_seconds: a session that is silent for this long is dropped, even if it waits for samples. Its
            consumer opens it again with its next request, so the limit only bounds the cost of abandoned consumers.
        max_credit_bytes: bound on the bytes in flight to one consumer.
        quarantine: the snapshots; new entries are added to it once they are on disk.
        wall_clock: returns the time for a quarantine entry, ISO 8601.
        expected_workers: total number of workers expected, including other hosts. It sets a consumer's credit when the
            consumer connects, which may be before the first worker says hello.
        share_bytes: size limit of the finished samples kept for other consumers; 0: keep none.
        counters: totals since the start.
        leases: which worker makes what.
        sessions: the consumers.
        registry: the workers.
        ring: finished samples for other consumers; None: equal samples are made for each.
        makers: the request that has the lease of each sample that others may follow, by sharing key.
        followers: requests that wait for the sample of a maker.
        parked: clips that the free workers do not suit, oldest first.
        outgrown: memory that was not enough for a clip under a spec, bytes, by :func:`assignment.clip_key`. It lasts as
            long as the server: the next one may have larger workers.
        refusals: the last few, oldest first.
        blocked_reason: why no lease can be granted at the moment; empty if leases can be granted.
        faults: malformed messages and refused specs of connected consumers.
        columns: what the sequence tables of all specs have in common.
        tables: sequence tables kept for later consumers, by what they depend on.
    """

    facts: CorpusFacts
    default_spec: StreamSpec
    _: KW_ONLY
    lease_deadline_seconds: float
    max_credit_bytes: int
    quarantine: Quarantine
    wall_clock: Callable[[], str]
    session_idle_seconds: float = 600.0
    expected_workers: int = 0
    share_bytes: int = 0

    counters: Counters = field(init=False, default_factory=Counters)
    leases: LeaseBook = field(init=False)
    sessions: Sessions = field(init=False)
    registry: Workers = field(init=False)
    ring: SampleRing | None = field(init=False)
    makers: dict[Hashable, tuple[bytes, int, int]] = field(init=False, default_factory=dict)
    followers: dict[Hashable, list[Request]] = field(init=False, default_factory=dict)
    parked: list[ParkedClip] = field(init=False, default_factory=list)
    outgrown: dict[Hashable, int] = field(init=False, default_factory=dict)
    refusals: deque[RefusalPart] = field(init=False, default_factory=lambda: deque(maxlen=MOST_LATEST))
    blocked_reason: str = field(init=False, default="")
    faults: dict[bytes, int] = field(init=False, default_factory=dict)
    columns: Columns = field(init=False)
    tables: dict[tuple[object, ...], SequenceTable] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        self.leases = LeaseBook(self.lease_deadline_seconds)
        self.sessions = Sessions(self.leases)
        self.registry = Workers(self.leases)
        self.ring = SampleRing(self.share_bytes) if self.share_bytes else None
        self.columns = Columns(self.facts.videos)

    @property
    def workers(self) -> int:
        """Return the number of workers that said hello and are alive as far as is known."""
        return len(self.registry.members)

    @property
    def waiting(self) -> int:
        """Return the number of requested samples that are not leased to a worker yet."""
        parked = sum(len(clip.requests) for clip in self.parked)
        return parked + sum(len(session.waiting) for session in self.sessions)

    @property
    def waiting_share(self) -> float:
        """Share of the connected consumers that have requests without a worker: 0 to 1."""
        connected = [session for session in self.sessions if session.left_at is None]
        return sum(bool(session.waiting) for session in connected) / max(len(connected), 1)

    @property
    def consumers(self) -> int:
        """Return the number of consumers that are connected, as far as is known."""
        return sum(session.left_at is None for session in self.sessions)

    def has_session(self, identity: bytes) -> bool:
        """Return whether a peer is a consumer with a session, or a worker that said hello."""
        return self.sessions.get(identity) is not None or identity in self.registry.members

    def identity_of(self, request: Request) -> SampleId | None:
        """Return the identity of the sample that a request asks for; None if its consumer is gone."""
        session = self.sessions.get(request.session)
        if session is None:
            return None
        catalogue = self.facts.digest_under(session.spec.scene)
        return SampleId(session.spec.digest, catalogue, NUMERICS_VERSION, session.seed, request.epoch, request.index)

    def clip_of(self, request: Request) -> tuple[str, int] | None:
        """Return the video and first frame of the request's current candidate; None if its consumer is gone."""
        session = self.sessions.get(request.session)
        if session is None:
            return None
        sequence = session.sequence(request)
        return sequence.video.id, sequence.start_frame

    @property
    def idle_share(self) -> float:
        """Share of the workers that hold no lease: 0 to 1."""
        return (
            max(0.0, 1.0 - len(self.leases.held) / max(len(self.registry.members), 1)) if self.registry.members else 0.0
        )


def malformed(broker: Broker, error: ProtocolError) -> Frames:
    """Count a message that cannot be used, and build the reply."""
    broker.counters.malformed += 1
    return denial(ErrorCode.VERSION if isinstance(error, VersionMismatch) else ErrorCode.MALFORMED, str(error))
