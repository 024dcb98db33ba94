"""Track what each consumer asked for, its credit, and the order of service. No I/O; time is passed in.

The server keeps no position: a consumer asks for indices, each of which is one unit of its credit until it is answered,
and an index that was answered is forgotten. So a session can be dropped and opened again at any time.

Worker time is shared by deficit round robin (:mod:`v2v_server.broker.fair_queue`). A repeated Hello changes none of
this: the new session takes over the debt of the old one, and its abandoned requests count against its credit until the
workers have finished them.

Memory: a session's samples in work and those that its consumer has not read are together at most its credit. Its
unread bytes are at most an equal share of MOST_IN_FLIGHT_BYTES, or one sample. So a consumer that never reads holds at
most its credit, all of them together hold about MOST_IN_FLIGHT_BYTES, and none delays the others.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count

from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.arena import Slot
from v2v_protocol.errors import CorpusError, LimitExceeded, UsageError
from v2v_protocol.liveness import Liveness
from v2v_protocol.messages import LARGEST_ARRAY_BYTES, MOST_IN_FLIGHT_BYTES, Hello, Welcome
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import Form, array_layout, layout_bytes
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.fair_queue import FairQueue
from v2v_server.broker.leases import LeaseBook, Request, runs_alone
from v2v_server.broker.worker_registry import clean_name
from v2v_server.corpus.videos import CorpusFacts
from v2v_server.quarantine.snapshots import Quarantine
from v2v_server.schedule.epoch import Schedule
from v2v_server.schedule.sequences import MOST_CLIP_BYTES, Columns, SequenceTable

MOST_BATCH_SIZE = 65_536
MOST_CREDIT = 400
"""Less than ``router.MOST_QUEUED``, the number of queued messages at which a consumer is disconnected."""
MOST_TABLES = 16
"""Sequence tables cached for later consumers. A session keeps its own, which is small."""


GONE_SECONDS = 10.0
"""Time that a consumer has to return to its session after its connection ended."""
SILENT_SECONDS = 60.0
AWAY_SECONDS = 2.0
"""Between two epochs a consumer is away for a shorter time."""
RETURN_SECONDS = 60.0
"""A consumer that says Hello within this time of the last message of one with the same name continues its totals."""
_MOST_DEPARTED = 1024
"""Number of departed consumers whose totals are remembered; the oldest is dropped first."""


def suggested_credit(batch_size: int, workers: int, samples_per_decode: int) -> int:
    """Return how many samples a consumer should have outstanding: one batch ahead, and two for each worker.

    With K samples per decode the count is in blocks of ``batch_size`` clips with K samples each. A worker gets the
    siblings of a clip together only if all of them have been requested. So the credit covers the blocks in work (two
    clips for each worker) and one more. It is then raised by a seventh, because our client asks only when an eighth of
    its credit is free.
    """
    ahead = 2 * max(1, workers)
    if samples_per_decode == 1:
        return max(2 * batch_size, ahead)
    under_way = batch_size * samples_per_decode * (1 + -(-ahead // batch_size))
    return under_way + -(-under_way // 7)


class Admission:
    """Turn what consumers ask for into sessions.

    Args:
        facts: what is known of the videos, in memory.
        default_spec: the spec of a consumer that sends none.
        max_credit_bytes: bound on the bytes in flight to one consumer.
        session_idle_seconds: a session that is silent for this long is dropped, even if it waits for samples. Its
            consumer opens it again with its next request, so the limit only bounds the cost of abandoned consumers.
        quarantine: the snapshots that a consumer may ask for.
    """

    def __init__(
        self,
        facts: CorpusFacts,
        default_spec: StreamSpec,
        max_credit_bytes: int,
        session_idle_seconds: float,
        quarantine: Quarantine,
    ) -> None:
        self._facts = facts
        self._default_spec = default_spec
        self._max_credit_bytes = max_credit_bytes
        self._session_idle_seconds = session_idle_seconds
        self._quarantine = quarantine
        self._columns = Columns(facts.videos)
        self._tables: dict[tuple[object, ...], SequenceTable] = {}

    def admit(self, identity: bytes, hello: Hello, workers: int, now: float) -> tuple[Session, Welcome]:
        """Open the session that a consumer asks for, and return it with the reply.

        Args:
            identity: the consumer's routing id.
            hello: its message.
            workers: number of workers, present or expected; the credit keeps all of them busy, within its bounds.
            now: monotonic time, seconds.

        Raises:
            UsageError, CorpusError: the request cannot be served.
        """
        if not 1 <= hello.batch_size <= MOST_BATCH_SIZE:
            raise UsageError(f"batch_size = {hello.batch_size}: give 1 to {MOST_BATCH_SIZE}")
        spec = StreamSpec.from_dict(hello.spec, self._default_spec)
        spec = spec.spaced(hello.stride or hello.batch_size)
        layout = array_layout(spec.recipe, spec.voxel_dtype, hello.arrays)
        self._check_sizes(spec.recipe, layout)
        self._facts.require_arrays(hello.arrays)
        newest = self._quarantine.latest
        quarantine = newest if hello.quarantine is None else hello.quarantine
        if quarantine > newest:
            raise CorpusError(
                f"quarantine snapshot {quarantine} was asked for, this server has 0 .. {newest}: the stream follows "
                "entries that this server has not read. Replace this server's quarantine file with that of the "
                "stream's earlier server (v2v-quarantine --videos DIR prints its path), and restart this server; if "
                'they are the same file, just restart. To continue without these entries, set "quarantine" of the '
                "saved state to None: the sequences that they refused then return"
            )
        table = self._table(spec)
        schedule = Schedule.of(table, spec)
        if not schedule.count:
            raise UsageError(
                f"{table.count} sequences do not fill a block of sibling_spacing = {spec.sibling_spacing}: use a "
                "smaller batch size, fewer ranks or loader workers, samples_per_decode = 1, or more videos"
            )
        suggested = suggested_credit(hello.batch_size, workers, spec.samples_per_decode)
        session = Session(
            identity=identity,
            spec=spec,
            seed=hello.seed,
            arrays=hello.arrays,
            batch_size=hello.batch_size,
            schedule=schedule,
            credit=min(suggested, MOST_CREDIT, self._max_credit_bytes // layout_bytes(layout)),
            liveness=Liveness(now, gone_seconds=self._session_idle_seconds),
            quarantine=quarantine,
            since=now,
            packed=hello.packed,
            name=clean_name(hello.name),
            host=clean_name(hello.host),
        )
        return session, Welcome(
            spec=spec.to_dict(),
            spec_digest=spec.digest,
            catalogue_digest=self._facts.digest_under(spec.scene),
            numerics_version=NUMERICS_VERSION,
            sequences=schedule.count,
            credit=session.credit,
            quarantine=quarantine,
            sidecars=self._facts.sidecars_digest(hello.arrays),
        )

    def _check_sizes(self, recipe: Recipe, layout: Mapping[str, tuple[str, tuple[int, ...]]]) -> None:
        remedy = "ask for fewer voxels_per_clip or a smaller crop"
        for name, (dtype, shape) in layout.items():
            size = layout_bytes({name: (dtype, shape)})
            if size > LARGEST_ARRAY_BYTES:
                raise UsageError(
                    f"array {name} {dtype}{list(shape)} of one sample is {size} bytes; the limit is "
                    f"{LARGEST_ARRAY_BYTES}: {remedy}"
                )
        # The view of an enlarged picture may be larger than the picture, which the sequences are bounded by. How many
        # frames a duration has depends on the video.
        view = (recipe.steps + 1) * recipe.crop_height_px * recipe.crop_width_px
        if view > MOST_CLIP_BYTES and not recipe.is_timed:
            raise UsageError(
                f"the {recipe.steps + 1} frames of {recipe.crop_width_px}x{recipe.crop_height_px} px of one sample "
                f"are {view >> 20} MiB; the limit is {MOST_CLIP_BYTES >> 20} MiB: {remedy}"
            )
        if layout_bytes(layout) > self._max_credit_bytes:
            raise UsageError(
                f"one sample is {layout_bytes(layout)} bytes; the server's --max-credit-bytes is "
                f"{self._max_credit_bytes}: raise it, or {remedy}"
            )

    def _table(self, spec: StreamSpec) -> SequenceTable:
        recipe = spec.recipe
        # The sequences depend only on these fields, so many specs share a table.
        geometry = (
            recipe.frames_needed,
            spec.samples_per_decode,
            recipe.frames_per_sequence,
            recipe.frame_stride,
            recipe.voxel_seconds[1],
            recipe.crop_height_px,
            recipe.crop_width_px,
            recipe.resize_scale,
            recipe.light,
            spec.flow_margin_px,
            spec.substep_px > 0.0,
            spec.voxel_dtype,
            spec.max_sequences_per_video,
            spec.scene,
            spec.kept_defects,
            spec.still_share,
            spec.quiet_share,
        )
        table = self._tables.get(geometry)
        if table is None:
            table = SequenceTable(self._facts.videos, self._facts.rows, spec, self._columns)
            if not table.count:
                raise UsageError(f"none of the {len(table.refusals)} videos gives a sequence; {table.refusals[0]}")
            while len(self._tables) >= MOST_TABLES:
                del self._tables[next(iter(self._tables))]
            self._tables[geometry] = table
        return table


@dataclass(slots=True)
class ConsumerTotals:
    """What a consumer got in all of its sessions: a trainer opens one for each epoch, and after each reconnect.

    Attributes:
        number: of the consumer, from 0; no other one has it.
        since: when it came, or returned after :data:`AWAY_SECONDS` or more.
        left_at: when its last session ended; None while it has one.
        present_seconds: for how long it was there before ``since``.
        served: samples sent.
        waited_seconds: time that it waited for samples, as it reports.
        passed: by how many indices its position advanced, over all epochs.
    """

    number: int
    since: float
    left_at: float | None = None
    present_seconds: float = 0.0
    served: int = 0
    waited_seconds: float = 0.0
    passed: int = 0

    def present(self, now: float) -> float:
        """Return for how long it was there until now; pauses shorter than :data:`AWAY_SECONDS` count."""
        return self.present_seconds + (now if self.left_at is None else self.left_at) - self.since

    def resume(self, now: float) -> None:
        """Note a new session of the consumer."""
        if self.left_at is not None and now - self.left_at >= AWAY_SECONDS:
            self.present_seconds, self.since = self.present(now), now
        self.left_at = None


@dataclass(slots=True)
class Session:
    """One consumer.

    Attributes:
        identity: its routing id.
        spec, seed, arrays, batch_size: what it asked for.
        schedule: the order of its samples.
        credit: largest number of indices that it may have requested and not yet received.
        liveness: when it was last heard.
        waiting: requests without a worker, in the order of the request.
        unanswered: every requested (epoch, index) that is not yet answered.
        totals: what it got, this session and earlier ones.
        quarantine: number of the quarantine snapshot that its samples are made under.
        left_at: when its connection ended; None while it is connected, as far as is known.
        since: when it was opened.
        packed: whether it asks for compressed arrays.
        name, host: names that the consumer gives for itself.
        epoch: the epoch that it last requested samples of.
        position: index after the highest answered index of that epoch; before the first answer, the lowest requested.
        waited_seconds: time that it has waited for samples since its Hello, as it reports.
        user: name of its connection's key; empty without keys.
        owner: digest of that key and of the secret of its Hello; empty without a secret.
        form: the form of one of its samples.
    """

    identity: bytes
    spec: StreamSpec
    seed: int
    arrays: tuple[str, ...]
    batch_size: int
    schedule: Schedule
    credit: int
    liveness: Liveness
    waiting: deque[Request] = field(default_factory=deque)
    unanswered: set[tuple[int, int]] = field(default_factory=set)
    quarantine: int = 0
    left_at: float | None = None
    since: float = 0.0
    packed: bool = False
    name: str = ""
    host: str = ""
    epoch: int = 0
    position: int = 0
    waited_seconds: float = 0.0
    user: str = ""
    owner: bytes = b""

    totals: ConsumerTotals = field(init=False)
    form: Form = field(init=False)

    def __post_init__(self) -> None:
        self.totals = ConsumerTotals(0, self.since)
        self.form = Form.of(array_layout(self.spec.recipe, self.spec.voxel_dtype, self.arrays))

    def mark_heard(self, now: float) -> None:
        """Note a message from the consumer."""
        self.liveness.mark_heard(now)
        self.left_at = None

    def add_wait(self, seconds: float, now: float) -> float:
        """Update the consumer's total waiting time.

        Args:
            seconds: the new total as the consumer reports it.
            now: monotonic time, seconds.

        Returns:
            the increase, bounded by the age of the session.
        """
        more = max(0.0, min(seconds, now - self.since) - self.waited_seconds)
        self.waited_seconds += more
        self.totals.waited_seconds += more
        return more

    @property
    def display(self) -> tuple[object, ...]:
        """Return what identifies the consumer in the status. Its secret does not: it changes with each epoch."""
        return self.user, self.name, self.host, self.spec.digest, self.seed


class Sessions:
    """All consumers, and the order in which they are served.

    Args:
        leases: the leases that are out. They say how many samples workers still make that a consumer abandoned in an
            earlier session.
    """

    def __init__(self, leases: LeaseBook) -> None:
        self._leases = leases
        self._sessions: dict[bytes, Session] = {}
        self._in_flight: dict[bytes, int] = {}
        self._departed: deque[tuple[tuple[object, ...], ConsumerTotals]] = deque(maxlen=_MOST_DEPARTED)
        self._numbers = count()
        self._queue = FairQueue()

    def __len__(self) -> int:
        return len(self._sessions)

    def __iter__(self) -> Iterator[Session]:
        return iter(self._sessions.values())

    def get(self, identity: bytes) -> Session | None:
        """Return the session of a consumer; None if it has none."""
        return self._sessions.get(identity)

    def open(self, session: Session) -> None:
        """Add a session. It replaces a session with the same routing id or owner: old requests are dropped, the debt
        stays.
        """
        replaced = {session.identity, *self.owned_by(session.owner)}
        for before in replaced:
            self.forget(before)
        session.totals = self._totals_of(session)
        self._sessions[session.identity] = session
        self._queue.add(session.identity, replaced)

    def totals(self) -> Iterator[ConsumerTotals]:
        """Yield the totals of all consumers, and of those that left and may return."""
        yield from (session.totals for session in self)
        yield from (totals for _, totals in self._departed)

    def _totals_of(self, session: Session) -> ConsumerTotals:
        """Return the totals of the consumer that opens a session: those of its last one, if it left a moment ago."""
        wanted, earliest = session.display, session.since - RETURN_SECONDS
        for place in range(len(self._departed) - 1, -1, -1):
            display, totals = self._departed[place]
            if display == wanted and (totals.left_at or 0.0) > earliest:
                del self._departed[place]
                totals.resume(session.since)
                return totals
        return ConsumerTotals(next(self._numbers), session.since)

    def owned_by(self, owner: bytes) -> list[bytes]:
        """Return the routing ids of an owner's sessions; an empty list for an empty owner."""
        return [each.identity for each in self if owner and each.owner == owner]

    def forget(self, identity: bytes) -> None:
        """Drop a session, if there is one; its debt is remembered."""
        session = self._sessions.pop(identity, None)
        if session is not None:
            session.totals.left_at = session.liveness.heard_at
            self._departed.append((session.display, session.totals))
            self._queue.remove(identity)

    def charge(self, identity: bytes, seconds: float) -> None:
        """Charge worker time to a consumer, whether it is connected or not."""
        self._queue.charge(identity, seconds)

    def balance_seconds(self, identity: bytes) -> float:
        """Return the worker time that a consumer has earned and not used; negative: its debt."""
        return self._queue.balance_seconds(identity)

    def want(self, session: Session, epoch: int, indices: Sequence[int], slots: Sequence[Slot | None] = ()) -> None:
        """Queue requests of a consumer. Samples that it already waits for are not made twice, and keep their slots.

        Args:
            session: of the consumer.
            epoch, indices: which samples.
            slots: where each may be put, in the order of ``indices``; empty: no slots.

        Raises:
            LimitExceeded: the credit would be exceeded; nothing is queued.
            IndexError: an index is outside the epoch; nothing is queued.
        """
        places: dict[int, Slot | None] = dict(zip(indices, slots, strict=True)) if slots else dict.fromkeys(indices)
        new = [index for index in places if (epoch, index) not in session.unanswered]
        for index in new:
            if index >= session.schedule.count:
                raise IndexError(f"index {index} of an epoch of {session.schedule.count} sequences")
        if len(session.unanswered) + len(new) > session.credit:
            raise LimitExceeded(
                f"{len(new)} more samples asked while {len(session.unanswered)} are unanswered; "
                f"the credit is {session.credit}"
            )
        is_first = not (session.unanswered or session.position)
        if new and (is_first or epoch != session.epoch):
            session.epoch, session.position = epoch, min(new)
        for index in new:
            session.unanswered.add((epoch, index))
            place = session.schedule.place(index)
            session.waiting.append(Request(session.identity, epoch, index, place=place, slot=places[index]))
        self._requeue(session)

    def take_waiting(self, session: Session, requests: Collection[Request]) -> None:
        """Take waiting requests of a session that are answered without a worker of their own."""
        session.waiting = deque(request for request in session.waiting if request not in requests)
        self._requeue(session)

    def next_request(self) -> Request | None:
        """Take the next request to give to a worker; None if no session waits."""
        for identity in self._leases.take_released():
            if (session := self._sessions.get(identity)) is not None:
                self._requeue(session)
        if (first := self._queue.next()) is None:
            return None
        session = self._sessions[first]
        request = session.waiting.popleft()
        self._requeue(session)
        return request

    def set_in_flight(self, identity: bytes, nbytes: int) -> Session | None:
        """Note how many bytes are in flight to a peer; return its session if there were more before."""
        before = self._in_flight.pop(identity, 0)
        if nbytes:
            self._in_flight[identity] = nbytes
        if (session := self._sessions.get(identity)) is not None:
            self._requeue(session)
        return session if nbytes < before else None

    def room(self, session: Session) -> int:
        """Return how many more requests of a session may be served now, which may be negative.

        One sample, or 64 KiB of small ones, may have been read although it still counts.
        """
        sample, unread = sum(session.form.sizes), self._in_flight.get(session.identity, 0)
        if unread and unread >= max(sample, MOST_IN_FLIGHT_BYTES // len(self._in_flight)):
            return 0
        at_work = len(session.unanswered) - len(session.waiting) + self._leases.abandoned(session.identity)
        return session.credit - at_work - max(0, unread - max(sample, 1 << 16)) // sample

    def _requeue(self, session: Session) -> None:
        """Queue a session if it has waiting requests and room for them; else dequeue it."""
        self._queue.set_waiting(session.identity, waits=bool(session.waiting) and self.room(session) > 0)

    def take_siblings(self, request: Request) -> list[Request]:
        """Take the waiting requests that are made from the same clip as ``request``."""
        session = self._sessions.get(request.session)
        if session is None or session.spec.samples_per_decode == 1:
            return []
        siblings = [other for other in session.waiting if other.clip == request.clip and not runs_alone(other)]
        for sibling in siblings:
            session.waiting.remove(sibling)
        self._requeue(session)
        return siblings

    def put_back(self, request: Request) -> None:
        """Put a request back that was not answered. It is served next, because its consumer has waited longest for
        it.
        """
        session = self._sessions.get(request.session)
        if session is not None and (request.epoch, request.index) in session.unanswered:
            session.waiting.appendleft(request)
            self._requeue(session)

    def mark_answered(self, request: Request, worker_seconds: float) -> bool:
        """Close a request; return False if it is not wanted: the session is gone, or the request was answered
        before.
        """
        session = self._sessions.get(request.session)
        if session is None or (request.epoch, request.index) not in session.unanswered:
            return False
        session.unanswered.remove((request.epoch, request.index))
        if request.epoch == session.epoch:
            before, session.position = session.position, max(session.position, request.index + 1)
            session.totals.passed += session.position - before
        self._queue.charge(request.session, worker_seconds)
        self._requeue(session)
        if not session.unanswered:
            self._queue.drop_savings(request.session)
        session.totals.served += 1
        return True

    def idle(self, now: float) -> list[bytes]:
        """Return the sessions to forget: silent for too long, or without a connection."""
        return [
            session.identity
            for session in self._sessions.values()
            if session.liveness.is_gone(now) or (session.left_at is not None and now - session.left_at >= GONE_SECONDS)
        ]

    def dispensable(self, now: float) -> list[bytes]:
        """Return the sessions to forget if others need their place. A live consumer sends a message every few
        seconds.
        """
        return [
            session.identity
            for session in self._sessions.values()
            if session.left_at is not None or session.liveness.silence(now) >= SILENT_SECONDS
        ]
