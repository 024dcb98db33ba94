"""Decide what the server does: messages and lost peers in, actions out. No sockets, no processes, no clock.

Consumers send Want, sessions queue requests, free workers get leases, and results are passed on unchanged. Every
message from a peer leads to an action or a counted fault, never to an exception: one bad peer must not stop the others.

A candidate is refused because its video failed, because it brought a worker down (written to the quarantine first), or
because it already is in quarantine. The refusals travel with the request into the sample's provenance.

A lease holds everything that a worker on any host needs, and nothing else. Its result is checked before it is passed
on: a consumer trusts its server, but the server does not trust a worker, which may run another version, be broken or be
hostile. Only the small header is read. The arrays are measured, unless they lie in a slot.

With a ring, equal samples are made once. A request for one that is being made follows its *maker*, the request that has
the lease; one in the ring is answered at once. If the maker's lease ends without a sample, its followers wait again.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.arena import NO_SLOT, ArenaName, Slot
from v2v_protocol.errors import CorpusError, IndexUnreadable, LimitExceeded, ProtocolError, UsageError, V2VError
from v2v_protocol.liveness import Liveness
from v2v_protocol.messages import (
    LARGEST_ARRAY_BYTES,
    LARGEST_REQUEST_BYTES,
    Begun,
    Buffer,
    Denied,
    ErrorCode,
    Frames,
    GetStatus,
    Goodbye,
    Hello,
    Lease,
    LeaseFailed,
    Message,
    Notes,
    Ping,
    Pong,
    Result,
    SampleHeader,
    Stop,
    Unavailable,
    Want,
    Welcome,
    WorkerHello,
    decode,
    encode,
    largest_packed_bytes,
)
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import Form, Refusal, RefusalKind, SampleId, array_layout, layout_bytes, needs_of
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.leases import (
    MOST_WORKERS,
    SILENCE_SECONDS,
    Cause,
    Loss,
    Request,
    Stall,
    bounded_seconds,
    clean_name,
    judge,
    runs_alone,
)
from v2v_server.broker.session import Session
from v2v_server.broker.state import (
    Action,
    AddToQuarantine,
    Broker,
    CheckVideo,
    Disconnect,
    GiveUp,
    ParkedClip,
    RefusalPart,
    ReportRefusal,
    SendStatus,
    ToConsumer,
    ToWorker,
    denial,
    malformed,
)
from v2v_server.corpus.videos import CorpusFacts, VideoEntry
from v2v_server.lease_memory import LARGEST_MEMORY_BYTES, MOST_CLIP_BYTES, lease_bytes
from v2v_server.quarantine import QuarantineEntry
from v2v_server.schedule import MOST_CANDIDATES, Schedule, SequenceTable, VideoSequence
from v2v_server.sharing import SharedSample

MOST_SESSIONS = 4096
MOST_FAULTS = 16
"""Malformed messages and refused specs after which a consumer is disconnected: an answer costs as much as a sample."""
MOST_BATCH_SIZE = 65_536
MOST_CREDIT = 400
"""Less than ``router.MOST_QUEUED``, the number of queued messages at which a consumer is disconnected."""
MOST_TABLES = 16
"""Sequence tables cached for later consumers. A session keeps its own, which is small."""
TOO_LARGE_SECONDS = 5.0
"""Time after which a sample that takes more memory than every worker has is an error."""
LONGEST_REASON = 500
"""Characters kept of a refusal's reason."""
_DECODE_SECONDS = 5e-8
"""For each pixel of a frame: ten times the time of a slow codec on a slow core. The other limits are as generous."""
_FLOW_SECONDS = 1e-6
_SIMULATION_SECONDS = 1e-7
_LONGEST_SECRET_BYTES = 64
_LONGEST_NAME_BYTES = 255


class Dispatcher(Broker):
    """Assign requests of consumers to workers: the broker's value, with what changes it from outside."""

    # --- consumers ---------------------------------------------------------------------------------------------------

    def from_consumer(self, identity: bytes, frames: Sequence[Buffer], now: float, user: str = "") -> list[Action]:
        """Handle a message from the consumers' side.

        Args:
            identity: routing id of the connection.
            frames: the message.
            now: monotonic time, seconds.
            user: name of the connection's key; empty without keys.
        """
        try:
            message = _only(frames)
        except ProtocolError as error:
            return [self._fault(identity, self._malformed(error))]
        session = self.sessions.get(identity)
        if session is not None and session.user != user:
            session = None  # a session belongs to one key
        if session is not None:
            session.mark_heard(now)
        match message:
            case Hello():
                return [self._hello(identity, message, now, user)]
            case Ping():
                trouble = self.blocked_reason or self.registry.trouble(self.expected_workers)
                of_clips = (
                    clip.trouble for clip in self.parked if clip.trouble and clip.requests[0].session == identity
                )
                return [ToConsumer(identity, encode(Pong(trouble or next(of_clips, ""))))]
            case GetStatus():
                return [SendStatus(identity)]
            case Goodbye():
                if session is not None:
                    self.counters.waited_seconds += session.add_wait(message.waited_seconds, now)
                    self.consumer_lost(identity)
                return []
            case Want():
                if session is None:
                    return [_deny(identity, ErrorCode.UNKNOWN_SESSION, "no session: say Hello (again)")]
                self.counters.waited_seconds += session.add_wait(message.waited_seconds, now)
                denials = self._want(session, message)
                return denials or [*_answer_shared(self, session), *_assign(self, now)]
            case WorkerHello():
                stray = ProtocolError("this is the consumers' port: connect to the address of --worker-bind")
                return [self._fault(identity, self._malformed(stray))]
            case _:
                stray = ProtocolError(f"consumers cannot send {type(message).__name__}")
                return [self._fault(identity, self._malformed(stray))]

    def in_flight(self, identity: bytes, nbytes: int, now: float) -> list[Action]:
        """Note how many bytes are on their way to a consumer, and serve the requests that waited for it to read."""
        session = self.sessions.set_in_flight(identity, nbytes)
        return [] if session is None else [*_answer_shared(self, session), *_assign(self, now)]

    def consumer_gone(self, identity: bytes, now: float) -> None:
        """Note that a consumer's connection has ended. The consumer may reconnect at once and find its session."""
        self.faults.pop(identity, None)
        session = self.sessions.get(identity)
        if session is not None:
            session.left_at = now

    def consumer_lost(self, identity: bytes) -> None:
        """Forget a consumer that left or cannot be reached any more."""
        self.sessions.forget(identity)
        _forget_session(self, identity)

    def _hello(self, identity: bytes, hello: Hello, now: float, user: str) -> Action:
        try:
            owner = owner_digest(user, hello.secret)
        except LimitExceeded as error:
            return _deny(identity, ErrorCode.MALFORMED, str(error))
        present = self.sessions.get(identity)
        if present is not None and (present.owner, present.user) != (owner, user):
            text = "this routing id belongs to the session of another consumer: connect with a random one"
            return _deny(identity, ErrorCode.MALFORMED, text)
        if present is None and len(self.sessions) >= MOST_SESSIONS:
            for silent in self.sessions.dispensable(now):
                self.consumer_lost(silent)
        if present is None and len(self.sessions) >= MOST_SESSIONS:
            return _deny(identity, ErrorCode.BUSY, f"this server has {MOST_SESSIONS} consumers, its limit")
        try:
            workers = max(len(self.registry), self.expected_workers)
            session, welcome = admit(self, identity, hello, workers, now)
            session.user, session.owner = user, owner
        except (UsageError, CorpusError) as error:
            return self._fault(identity, denial(ErrorCode.SPEC, str(error)))
        for before in {identity, *self.sessions.owned_by(owner)}:
            _forget_session(self, before)
        self.sessions.open(session)
        return ToConsumer(identity, encode(welcome))

    def _want(self, session: Session, want: Want) -> list[Action]:
        try:
            slots = _slots(want)
        except ProtocolError as error:
            return [self._fault(session.identity, self._malformed(error))]
        try:
            for index in want.indices[:1]:
                SampleId(session.spec.digest, self.facts.digest, NUMERICS_VERSION, session.seed, want.epoch, index)
            self.sessions.want(session, want.epoch, want.indices, slots)
        except LimitExceeded as error:
            return [_deny(session.identity, ErrorCode.CREDIT, str(error))]
        except (IndexError, UsageError) as error:
            return [_deny(session.identity, ErrorCode.RANGE, str(error))]
        return []

    def _fault(self, identity: bytes, answer: Frames) -> Action:
        """Answer a malformed message or a refused spec of a consumer; disconnect it after too many."""
        faults = self.faults[identity] = self.faults.pop(identity, 0) + 1
        if len(self.faults) > MOST_SESSIONS:
            del self.faults[next(iter(self.faults))]
        return ToConsumer(identity, answer) if faults <= MOST_FAULTS else Disconnect(identity)

    def _malformed(self, error: ProtocolError) -> Frames:
        self.counters.malformed += 1
        return malformed(error)

    # --- workers -----------------------------------------------------------------------------------------------------

    def from_worker(self, identity: bytes, frames: Sequence[Any], now: float, user: str = "") -> list[Action]:
        """Handle a message from the workers' side. The frames behind a Result are passed on unchanged.

        Args:
            identity: routing id of the connection.
            frames: the message.
            now: monotonic time, seconds.
            user: name of the connection's key; empty without keys, and for a worker of this host.
        """
        try:
            message = decode(frames[0] if frames else b"")
        except ProtocolError as error:
            # Our workers end when they hear this. What it was about is not known, so others get the leases.
            gone = Loss(Cause.KILLED, "sent a malformed message")
            lost = self.worker_lost(identity, gone, now) if identity in self.registry else []
            return [ToWorker(identity, self._malformed(error)), *lost]
        if isinstance(message, WorkerHello):
            return self._worker_hello(identity, message, now, user)
        if isinstance(message, GetStatus):
            return [SendStatus(identity, is_worker_side=True)]
        if isinstance(message, Hello):
            text = "this is the workers' port: connect to the address of --bind"
            return [ToWorker(identity, denial(ErrorCode.MALFORMED, text))]
        if not self.registry.mark_heard(identity, now):
            return [ToWorker(identity, encode(Denied(ErrorCode.UNKNOWN_SESSION, "unknown worker: say WorkerHello")))]
        match message:
            case Begun(lease):
                self.leases.mark_begun(lease, identity, now)
                return []
            case Result():
                return self._result(identity, message, frames[1:], now)
            case LeaseFailed():
                return self._lease_failed(identity, message, now)
            case Ping():
                return [ToWorker(identity, encode(Pong()))]
            case Goodbye():
                self.registry.note_unfit(message.notes.reason)
                return self._take_back(identity, Loss(Cause.KILLED, "left"), now)
            case _:
                self.counters.malformed += 1
                return []

    def worker_lost(self, identity: bytes, loss: Loss, now: float) -> list[Action]:
        """Reassign the leases of a worker that died, was given up, or is unreachable."""
        self.counters.workers_lost += 1
        return self._take_back(identity, loss, now)

    def worker_stalled(self, identity: bytes, stalled: Stall) -> None:
        """Extend the deadlines of a worker by the time in which it could not run."""
        self.counters.queued_seconds += stalled.queued_seconds
        self.leases.extend_deadlines(identity, stalled)

    def worker_unreachable(self, identity: bytes, now: float) -> list[Action]:
        """Take back the leases of a worker that a message did not reach and that no supervisor watches."""
        if identity not in self.registry:
            return []
        return self.worker_lost(identity, Loss(Cause.KILLED, "is not connected any more"), now)

    def stop_workers(self) -> list[ToWorker]:
        """Tell every worker to finish and leave."""
        return [ToWorker(identity, encode(Stop())) for identity in self.registry.members]

    def _worker_hello(self, identity: bytes, hello: WorkerHello, now: float, user: str) -> list[Action]:
        try:
            owner = owner_digest(user, hello.secret)
            before = self._replaced_by(identity, hello.name, owner, user)
        except LimitExceeded as error:
            return [ToWorker(identity, self._malformed(error))]
        again = Loss(Cause.KILLED, "started again")
        actions = [action for each in before for action in self._take_back(each, again, now)]
        if hello.numerics_version != NUMERICS_VERSION:
            text = f"worker numerics version {hello.numerics_version}, the server's is {NUMERICS_VERSION}"
            return [ToWorker(identity, encode(Denied(ErrorCode.VERSION, text))), *actions]
        if len(self.registry) >= MOST_WORKERS:
            text = f"this server has {MOST_WORKERS} workers, its limit"
            return [ToWorker(identity, denial(ErrorCode.BUSY, text)), *actions]
        self.registry.add(identity, hello, now, user, owner)
        return actions + _assign(self, now)

    def _replaced_by(self, identity: bytes, name: str, owner: bytes, user: str) -> list[bytes]:
        """Return the connections that a worker's hello replaces: its own ones.

        Raises:
            LimitExceeded: one of them is another worker's, or the name is too long.
        """
        if len(name.encode()) > _LONGEST_NAME_BYTES:
            raise LimitExceeded(f"the name has {len(name.encode())} bytes; the limit is {_LONGEST_NAME_BYTES}")
        members = self.registry.members
        before = [each for each in {identity, self.registry.named(name)} if each is not None and each in members]
        for each in before:
            is_own = members[each].owner == owner and (bool(owner) or each == identity)
            # A worker of this host needs no key. Its supervisor knows it by its name, so no key can hold that.
            if not is_own and (user or not members[each].user):
                raise LimitExceeded(
                    f"a worker with the name or routing id of {clean_name(name)!r} is connected; both must be unique: "
                    "start this one with another --name"
                )
        return before

    def _result(self, identity: bytes, result: Result, payload: Sequence[Any], now: float) -> list[Action]:
        request = self.leases.request(result.lease, identity)
        session = None if request is None else self.sessions.get(request.session)
        actions: list[Action] = []
        decoded = True
        if request is None or session is None:
            self.counters.late_results += 1
            self._charge(result.lease, identity, now)
        else:
            try:
                header = check_result(payload, _as_leased(self, request, result.lease), session.form)
            except ProtocolError as error:
                # Our workers never send such a result; a worker that sends one would send more.
                refused = ToWorker(identity, self._malformed(ProtocolError(f"malformed result: {error}")))
                return [refused, *self.worker_lost(identity, Loss(Cause.KILLED, "sent a malformed result"), now)]
            decoded = header.decoded
            actions += _deliver(self, session, request, result.lease, header, payload)
            if actions:
                self.counters.add(result, header.cpu_seconds)
                self.registry.worked(identity, result, header.cpu_seconds)
        self.registry.can_work(identity)
        self.leases.finished(result.lease, identity, now, decoded=decoded)
        self.leases.mark_begun(result.begins, identity, now)
        return actions + _assign(self, now)

    def _lease_failed(self, identity: bytes, failed: LeaseFailed, now: float) -> list[Action]:
        self._charge(failed.lease, identity, now)
        request = self.leases.finished(failed.lease, identity, now)
        session = None if request is None else self.sessions.get(request.session)
        if request is None or session is None:
            return _assign(self, now)
        video, sidecar = session.sequence(request).video, failed.sidecar
        fingerprint = self.facts.sidecars_of(video.id, session.arrays).get(sidecar) if sidecar else video.fingerprint
        failure = CheckVideo(
            video.id, fingerprint or "", identity, failed.frame, failed.reason, request, sidecar if fingerprint else ""
        )
        if not failed.here:
            self.registry.can_work(identity)
            return [*_blame(self, failure), *_assign(self, now)]
        # The catalogue lists this host's files: if the file is here, other workers can probably read it.
        return [failure]

    def _charge(self, lease: int, worker: bytes, now: float) -> None:
        """Charge a consumer for a sample that it asked for and then abandoned."""
        debt = self.leases.debt(lease, worker, now)
        if debt is not None:
            self.sessions.queue.charge(*debt)

    def _take_back(self, identity: bytes, loss: Loss, now: float) -> list[Action]:
        limit_bytes = self.registry.members[identity].limit_bytes if identity in self.registry else 0
        self.registry.remove(identity)
        actions: list[Action] = []
        returned = self.leases.lost(identity, loss.lease)
        self.counters.returned_leases += len(returned)
        for request, begun in reversed(returned):
            if begun and loss.cause is Cause.MEMORY and runs_alone(request):
                _mark_outgrown(self, request, limit_bytes)
            verdict = judge(request, loss) if begun else request
            if isinstance(verdict, Request):
                self.sessions.put_back(verdict)
            else:
                actions += _quarantine_candidate(
                    self, request, verdict, for_all=loss.for_all and loss.cause is not Cause.UNEXPLAINED
                )
        return actions + _assign(self, now)

    # --- what comes of actions, and of time ---------------------------------------------------------------------------

    def quarantine_recorded(
        self, record: AddToQuarantine, written: Sequence[QuarantineEntry], now: float
    ) -> list[Action]:
        """Continue after an :class:`AddToQuarantine`.

        Args:
            record: the action.
            written: the lines that the quarantine has gained, including those of other processes; empty if it cannot be
                written.
            now: monotonic time, seconds.
        """
        before = self.quarantine.latest
        self.quarantine.extend(written)
        # Consumers under the newest snapshot move on to the new one. A consumer that resumed an older snapshot keeps
        # it: entries cleared since must not return, and sequences that it refused must stay refused.
        for each in self.sessions:
            if each.quarantine == before:
                each.quarantine = self.quarantine.latest
        return [*_refuse_quarantined(self, record.request, record.entry.reason), *_assign(self, now)]

    def video_checked(self, missing: CheckVideo, found: bool, now: float) -> list[Action]:
        """Continue after a :class:`CheckVideo`: blame the video, or the worker's host.

        Args:
            missing: the action.
            found: whether this host has the video as catalogued.
            now: monotonic time, seconds.
        """
        if not found:
            return [*_blame(self, missing), *_assign(self, now)]
        self.counters.missing_videos += 1
        self.registry.rest(missing.identity, now, f"{missing.video}: {missing.reason}")
        self.sessions.put_back(missing.request)
        return _assign(self, now)

    def tick(self, now: float) -> list[Action]:
        """Apply deadlines, lease slow samples to a second worker, and forget silent peers. Call a few times a
        second.
        """
        for identity in self.sessions.idle(now):
            self.consumer_lost(identity)
        actions: list[Action] = []
        self.blocked_reason = ""  # cleared so that the next lease is tried
        self.registry.wake(now)
        for identity in self.registry.hanging(now):
            actions.append(GiveUp(identity, f"gave no answer for {self.leases.limit_seconds(identity):g} s"))
        for identity in self.registry.vanished(now):
            actions.append(GiveUp(identity, f"was silent for {SILENCE_SECONDS:g} s"))
        actions += _check_parked(self, now)
        second = _assign_slow(self, now)
        self.counters.second_leases += len(second)
        actions += second
        # A consumer that left may have freed a worker that was reserved for its requests.
        return actions + _assign(self, now)


# --- what a consumer may ask for --------------------------------------------------------------------------------------


def _only(frames: Sequence[Buffer]) -> Message:
    if len(frames) != 1:
        raise ProtocolError(f"message with {len(frames)} frames; this kind has one")
    return decode(frames[0], LARGEST_REQUEST_BYTES)


def _slots(want: Want) -> list[Slot | None]:
    """Return where the samples may be put.

    Raises:
        ProtocolError: a slot does not exist, or the numbers of slots and indices differ.
    """
    if not len(want.arenas) == len(want.slots) in (0, len(want.indices)):
        raise ProtocolError(f"want: {len(want.arenas)} arenas, {len(want.slots)} slots for {len(want.indices)} indices")
    numbers = {arena: (1, ArenaName.parse(arena).slots) for arena in set(want.arenas) - {""}}
    numbers[""] = NO_SLOT, NO_SLOT
    for arena, number in zip(want.arenas, want.slots, strict=True):
        least, most = numbers[arena]
        if not least <= number <= most:
            raise ProtocolError(f"want.slots: {number} of arena {arena!r:.80}; it has {least} to {most}")
    return [Slot(arena, number) if arena else None for arena, number in zip(want.arenas, want.slots, strict=True)]


def _deny(identity: bytes, code: ErrorCode, text: str) -> ToConsumer:
    return ToConsumer(identity, denial(code, text))


def owner_digest(user: str, secret: bytes) -> bytes:
    """Return a digest of the owner of a session or worker name: its key, if there are keys, and its secret.

    Raises:
        LimitExceeded: the secret is too long.
    """
    if len(secret) > _LONGEST_SECRET_BYTES:
        raise LimitExceeded(f"the secret has {len(secret)} bytes; the limit is {_LONGEST_SECRET_BYTES}")
    return hashlib.blake2b(secret, key=hashlib.sha256(user.encode()).digest()).digest() if secret else b""


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


def admit(broker: Broker, identity: bytes, hello: Hello, workers: int, now: float) -> tuple[Session, Welcome]:
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
    spec = StreamSpec.from_dict(hello.spec, broker.default_spec)
    spec = spec.spaced(hello.stride or hello.batch_size)
    layout = array_layout(spec.recipe, spec.voxel_dtype, hello.arrays)
    _check_sizes(broker, spec.recipe, layout)
    broker.facts.require_arrays(hello.arrays)
    newest = broker.quarantine.latest
    quarantine = newest if hello.quarantine is None else hello.quarantine
    if quarantine > newest:
        raise CorpusError(
            f"quarantine snapshot {quarantine} was asked for, this server has 0 .. {newest}: the stream follows "
            "entries that this server has not read. Replace this server's quarantine file with that of the "
            "stream's earlier server (v2v-quarantine --videos DIR prints its path), and restart this server; if "
            'they are the same file, just restart. To continue without these entries, set "quarantine" of the '
            "saved state to None: the sequences that they refused then return"
        )
    table = _table(broker, spec)
    schedule = Schedule(table, spec)
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
        credit=min(suggested, MOST_CREDIT, broker.max_credit_bytes // layout_bytes(layout)),
        liveness=Liveness(now, gone_seconds=broker.session_idle_seconds),
        quarantine=quarantine,
        since=now,
        packed=hello.packed,
        name=clean_name(hello.name),
        host=clean_name(hello.host),
    )
    return session, Welcome(
        spec=spec.to_dict(),
        spec_digest=spec.digest,
        catalogue_digest=broker.facts.digest_under(spec.scene),
        numerics_version=NUMERICS_VERSION,
        sequences=schedule.count,
        credit=session.credit,
        quarantine=quarantine,
        sidecars=broker.facts.sidecars_digest(hello.arrays),
    )


def _check_sizes(broker: Broker, recipe: Recipe, layout: Mapping[str, tuple[str, tuple[int, ...]]]) -> None:
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
    if layout_bytes(layout) > broker.max_credit_bytes:
        raise UsageError(
            f"one sample is {layout_bytes(layout)} bytes; the server's --max-credit-bytes is "
            f"{broker.max_credit_bytes}: raise it, or {remedy}"
        )


def _table(broker: Broker, spec: StreamSpec) -> SequenceTable:
    recipe = spec.recipe
    # The sequences depend only on these fields, so one table serves many specs.
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
        recipe.is_world,
        spec.flow_margin_px,
        spec.substep_px > 0.0,
        spec.voxel_dtype,
        spec.max_sequences_per_video,
        spec.scene,
        spec.kept_defects,
        spec.still_share,
        spec.quiet_share,
    )
    table = broker.tables.get(geometry)
    if table is None:
        table = SequenceTable(broker.facts.videos, broker.facts.rows, spec, broker.columns)
        if not table.count:
            raise UsageError(f"none of the {len(table.refusals)} videos gives a sequence; {table.refusals[0]}")
        while len(broker.tables) >= MOST_TABLES:
            del broker.tables[next(iter(broker.tables))]
        broker.tables[geometry] = table
    return table


# --- candidates and their refusals ------------------------------------------------------------------------------------


def _quarantined(broker: Broker, session: Session, request: Request, snapshot: int) -> str | None:
    """Return why the request's candidate is refused under a snapshot; None if it is not."""
    sequence = session.sequence(request)
    video = sequence.video
    return broker.quarantine.refusal(snapshot, video.id, video.fingerprint, sequence.start_frame, session.spec.digest)


def _quarantine_candidate(broker: Broker, request: Request, reason: str, *, for_all: bool = True) -> list[Action]:
    """Quarantine the request's candidate, which brought its worker down, unless it is in quarantine already.

    Args:
        request: the request at that candidate.
        reason: what happened.
        for_all: whether the entry holds for every spec; otherwise only for the spec of this request's session.
    """
    session = broker.sessions.get(request.session)
    if session is None:
        return []
    if _quarantined(broker, session, request, broker.quarantine.latest) is not None:
        return _refuse_quarantined(broker, request, reason)
    sequence = session.sequence(request)
    video, text = sequence.video, reason[:LONGEST_REASON]
    spec, time = "" if for_all else session.spec.digest, broker.wall_clock()
    return [
        AddToQuarantine(
            QuarantineEntry(0, video.id, video.fingerprint, sequence.start_frame, text, time, spec), request
        )
    ]


def _refuse_quarantined(broker: Broker, request: Request, reason: str) -> list[Action]:
    """Move the request to its next candidate. If the session's snapshot holds the entry, the refusal comes from the
    quarantine, which a later remake finds as well; otherwise it states what happened.
    """
    session = broker.sessions.get(request.session)
    if session is None:
        return []
    if _quarantined(broker, session, request, session.quarantine) is None:
        return _refuse(broker, request, None, reason)
    broker.sessions.put_back(replace(request, deaths=0))
    return []


def _refuse(
    broker: Broker, request: Request, frame: int | None, reason: str, kind: str = RefusalKind.FAILED
) -> list[Action]:
    """Move the request to its next candidate, or tell the consumer that the sample is unavailable and list all
    refusals.
    """
    session = broker.sessions.get(request.session)
    if session is None:
        return []
    broker.counters.refused_candidates += 1
    passed_over = next_candidate(request, Refusal(session.sequence(request).video.id, frame, reason, kind))
    last = passed_over.refusals[-1]
    broker.refusals.append(RefusalPart.of(last, broker.wall_clock()))
    # The operator was told when the candidate was quarantined.
    actions: list[Action] = [] if kind == RefusalKind.QUARANTINED else [ReportRefusal(last, request)]
    if passed_over.candidate < MOST_CANDIDATES and session.spec.on_bad_video == "substitute":
        broker.sessions.put_back(replace(passed_over, deaths=0))
        return actions
    return [*actions, *_fail(broker, request, "; ".join(dict.fromkeys(map(str, passed_over.refusals))))]


def _blame(broker: Broker, failure: CheckVideo) -> list[Action]:
    """Refuse a video. A sidecar never changes which video is shown: its consumer gets an error instead."""
    if failure.sidecar:
        return _fail(broker, failure.request, f"{failure.video}: its sidecar {failure.sidecar}: {failure.reason}")
    return _refuse(broker, failure.request, failure.frame, failure.reason)


def _fail(broker: Broker, request: Request, text: str) -> list[Action]:
    """Tell the consumer that a sample is unavailable, without blaming its video."""
    if not broker.sessions.mark_answered(request, 0.0):
        return []
    broker.counters.unavailable += 1
    return [ToConsumer(request.session, encode(Unavailable(request.epoch, request.index, text)))]


def next_candidate(request: Request, refusal: Refusal) -> Request:
    """Return the request at its next candidate.

    Args:
        request: the request at the refused candidate.
        refusal: of that candidate's video.
    """
    refusal = replace(refusal, reason=refusal.reason[:LONGEST_REASON])
    return replace(request, candidate=request.candidate + 1, refusals=(*request.refusals, refusal))


def _forget_session(broker: Broker, session: bytes) -> None:
    """Drop the requests of a consumer that is gone, and abandon its leases."""
    broker.leases.forget_session(session)
    broker.parked = [clip for clip in broker.parked if clip.requests[0].session != session]
    for key, followers in broker.followers.items():
        broker.followers[key] = [request for request in followers if request.session != session]


# --- which worker makes it --------------------------------------------------------------------------------------------


def _assign(broker: Broker, now: float) -> list[Action]:
    """Give waiting requests to workers until there are no requests or no free workers."""
    actions: list[Action] = []
    _release_followers(broker)
    while not broker.blocked_reason:
        parked = ((clip, worker) for clip in broker.parked if (worker := _worker_for(broker, clip)) is not None)
        clip, worker = next(parked, (None, None))
        if clip is not None and worker is not None:
            broker.parked.remove(clip)
            actions += _give(broker, clip.requests, worker, now)
            continue
        request = broker.sessions.next_request() if broker.registry.for_request(kept_bytes=_kept(broker)) else None
        if request is None:
            return actions
        siblings = [] if runs_alone(request) else broker.sessions.take_siblings(request)
        broker.parked.append(ParkedClip(needed_bytes(broker, request), [request, *siblings], now))
    return actions


def _kept(broker: Broker) -> int | None:
    """Return the memory of the worker to keep empty for the first request that runs alone; None if none waits."""
    return next((clip.needs_bytes for clip in broker.parked if runs_alone(clip.requests[0])), None)


def _worker_for(broker: Broker, clip: ParkedClip) -> bytes | None:
    """Return the worker for a clip; None if none that suits it is free."""
    if runs_alone(clip.requests[0]):
        return broker.registry.for_lone_request(clip.needs_bytes)
    return broker.registry.for_request(kept_bytes=_kept(broker), needs_bytes=clip.needs_bytes)


def _assign_slow(broker: Broker, now: float) -> list[Action]:
    """Give requests that take unusually long to a second worker each."""
    actions: list[Action] = []
    for request, worker in broker.leases.slow(now):
        second = broker.registry.for_request(
            kept_bytes=_kept(broker), other_than=worker, needs_bytes=needed_bytes(broker, request)
        )
        session = broker.sessions.get(request.session)
        if session is not None and second is not None and not runs_alone(request):
            slotless = replace(request, slot=None)  # the first worker may still write to the slot
            granted = _grant(broker, session, slotless, second, now)
            if granted is None:
                broker.sessions.put_back(slotless)
                break
            actions += granted
    return actions


def _give(broker: Broker, requests: list[Request], worker: bytes, now: float) -> list[Action]:
    """Give a worker the requests of one clip, except those whose candidate is in quarantine."""
    session = broker.sessions.get(requests[0].session)
    if session is None:
        return []
    actions: list[Action] = []
    good: list[Request] = []
    for request in requests:
        current = session.current(request)
        reason = _quarantined(broker, session, current, session.quarantine)
        if reason is not None:
            actions += _refuse(broker, current, None, reason, RefusalKind.QUARANTINED)
        elif (answer := _share(broker, session, current)) is not None:
            actions += answer
        else:
            good.append(current)
    for place, request in enumerate(good):
        granted = _grant(broker, session, request, worker, now, tuple(other.index for other in good[place + 1 :]))
        if granted is None:
            for each in reversed(good[place:]):
                broker.sessions.put_back(each)
            break
        actions += granted
    return actions


def _grant(
    broker: Broker, session: Session, request: Request, worker: bytes, now: float, siblings: tuple[int, ...] = ()
) -> list[Action] | None:
    """Lease a request to a worker, or refuse its candidate if the index of its video is damaged, belongs to another
    file, or is too large.

    Returns:
        None if the index cannot be read at the moment. No lease is granted until it is tried again.
    """
    sequence = session.sequence(request)
    seconds = work_seconds(session.spec, session.arrays, sequence.video)
    number = broker.leases.grant(request, worker, now, seconds)
    if broker.ring is not None:
        broker.makers[sharing_key(session, request)] = request.sample
        # A consumer without a slot is on another host, as far as is known, and gets a message.
        if request.slot is not None and not session.packed:
            broker.ring.lend(number, session.form.sizes)
    lease = lease_for(
        _as_leased(broker, request, number),
        number=number,
        sequence=sequence,
        facts=broker.facts,
        spec=session.spec,
        seed=session.seed,
        arrays=session.arrays,
        siblings=siblings,
        packed=session.packed,
    )
    try:
        lease = broker.complete(lease, session.spec)
        if not broker.registry.members[worker].takes_notes:
            lease = replace(lease, notes=Notes())
        return [ToWorker(worker, encode(lease), lease.arena)]
    except V2VError as error:
        broker.leases.finished(number, worker, now)
        if not isinstance(error, IndexUnreadable):
            return _refuse(broker, request, None, str(error))
        broker.blocked_reason = f"{error}; retried ten times a second"
        return None


# --- memory of workers ------------------------------------------------------------------------------------------------


def clip_key(session: Session, request: Request) -> Hashable:
    """Return a key that is equal for requests whose clips take equal memory."""
    sequence = session.sequence(request)
    return session.spec.digest, session.arrays, sequence.video.id, sequence.video.fingerprint, sequence.start_frame


def needed_bytes(broker: Broker, request: Request) -> int:
    """Return the memory that a worker needs for a request, bytes; 0 while every worker has enough for any."""
    session = broker.sessions.get(request.session)
    if session is None or (broker.registry.least_memory >= LARGEST_MEMORY_BYTES and not broker.outgrown):
        return 0
    request = session.current(request)
    video, arrays = session.sequence(request).video, sum(session.form.sizes)
    estimate = min(lease_bytes(video, broker.facts.rows, session.spec, arrays), LARGEST_MEMORY_BYTES)
    return max(broker.outgrown.get(clip_key(session, request), 0) + 1, estimate)


def _mark_outgrown(broker: Broker, request: Request, limit_bytes: int) -> None:
    """Note that a clip needs more memory than a worker had, which made nothing else and was killed at its limit.

    It is never put into quarantine: another server may have larger workers.
    """
    session = broker.sessions.get(request.session)
    if session is not None:
        key = clip_key(session, request)
        broker.outgrown[key] = max(limit_bytes, broker.outgrown.get(key, 0))


def _check_parked(broker: Broker, now: float) -> list[Action]:
    """Say which clips no worker can hold, and fail them once all expected workers have been there for a while: a larger
    one may be about to return.
    """
    actions: list[Action] = []
    most, is_complete = broker.registry.most_memory, len(broker.registry) >= max(1, broker.expected_workers)
    for clip in list(broker.parked):
        session = broker.sessions.get(clip.requests[0].session)
        clip.trouble = "" if session is None or clip.needs_bytes <= most else _describe(broker, session, clip)
        if not clip.trouble or not is_complete:
            clip.since = now
        elif now - clip.since >= TOO_LARGE_SECONDS:
            broker.parked.remove(clip)
            actions += [action for request in clip.requests for action in _fail(broker, request, clip.trouble)]
    return actions


def _describe(broker: Broker, session: Session, clip: ParkedClip) -> str:
    request = session.current(clip.requests[0])
    sequence, outgrown = session.sequence(request), broker.outgrown.get(clip_key(session, request), 0)
    needs = "more than " * (clip.needs_bytes == outgrown + 1) + f"{clip.needs_bytes / 1e9:.2f}"
    return (
        f"{sequence.video.id} from frame {sequence.start_frame} needs {needs} GB of memory under this spec, the "
        f"largest worker has {broker.registry.most_memory / 1e9:.2f}: give a worker more memory, or ask for fewer "
        "voxels_per_clip, fewer samples_per_decode, a smaller crop or resize_scale 1"
    )


# --- sharing ----------------------------------------------------------------------------------------------------------


def _as_leased(broker: Broker, request: Request, lease: int) -> Request:
    """Return a request with the slot that its lease names.

    Without a ring that is its own. With one it is the memory lent for this lease, or none: the ring needs the
    arrays.
    """
    return request if broker.ring is None else replace(request, slot=broker.ring.lent(lease))


def _answer_shared(broker: Broker, session: Session) -> list[Action]:
    """Answer waiting requests whose samples are in the ring, and let those that are being made follow."""
    if broker.ring is None:
        return []
    actions: list[Action] = []
    taken, room = set[Request](), broker.sessions.room(session)
    for request in list(session.waiting):
        if len(taken) < room and (answer := _share(broker, session, session.current(request))) is not None:
            actions += answer
            taken.add(request)
    broker.sessions.take_waiting(session, taken)
    return actions


def _deliver(
    broker: Broker, session: Session, request: Request, lease: int, header: SampleHeader, payload: Sequence[Any]
) -> list[Action]:
    """Send a finished sample to its consumer, and to those that wait for an equal one.

    Args:
        session, request: the consumer and the request that it was made for.
        lease: number of the lease.
        header: of the sample.
        payload: the frames of its message, with the header's.

    Returns:
        nothing if the sample is not wanted any more.
    """
    if not broker.sessions.mark_answered(request, bounded_seconds(header.cpu_seconds)):
        broker.counters.late_results += 1
        return []
    broker.counters.decodes += header.decoded
    broker.counters.count_cache(header.cache)
    broker.counters.count_sent(session.batch_size, session.form.sizes, in_slot=len(payload) == 1)
    if broker.ring is None:
        return [ToConsumer(request.session, payload)]
    key = sharing_key(session, request)
    sample = broker.ring.add(key, lease, header, payload[1:])
    broker.makers.pop(key, None)
    actions: list[Action] = [ToConsumer(request.session, sample.message(request.slot, is_first=True))]
    for follower in broker.followers.pop(key, ()):
        actions += _send_shared(broker, follower, sample)
    return actions


def _share(broker: Broker, session: Session, request: Request) -> list[Action] | None:
    """Answer a request from the ring, or let it wait for the lease that makes its sample; else return None."""
    if broker.ring is None:
        return None
    key = sharing_key(session, request)
    sample = broker.ring.get(key)
    if sample is not None:
        return _send_shared(broker, request, sample)
    maker = broker.makers.get(key)
    if maker not in broker.leases.out:
        return None
    broker.followers.setdefault(key, []).append(request)
    return []


def _send_shared(broker: Broker, request: Request, sample: SharedSample) -> list[Action]:
    session = broker.sessions.get(request.session)
    if session is None or not broker.sessions.mark_answered(request, 0.0):
        return []
    in_slot = sample.memory is not None and request.slot is not None
    broker.counters.count_sent(session.batch_size, session.form.sizes, in_slot=in_slot)
    broker.counters.samples += 1
    broker.counters.shared += 1
    return [ToConsumer(request.session, sample.message(request.slot, is_first=False))]


def _release_followers(broker: Broker) -> None:
    """Queue the followers of makers without a lease again, and free the memory of leases that have ended."""
    if broker.ring is None:
        return
    broker.ring.release(broker.leases)
    for key in [key for key, maker in broker.makers.items() if maker not in broker.leases.out]:
        del broker.makers[key]
        for request in reversed(broker.followers.pop(key, [])):
            broker.sessions.put_back(request)


def sharing_key(session: Session, request: Request) -> Hashable:
    """Return a key that is equal for requests whose samples, provenance included, are equal byte for byte and whose
    consumers have the same key.
    """
    return (
        session.user, session.spec.digest, session.seed, session.arrays, session.packed,
        request.epoch, request.index, request.candidate, request.refusals, request.snapshot,
    )  # fmt: skip


# --- a lease and its result -------------------------------------------------------------------------------------------


def lease_for(
    request: Request,
    *,
    sequence: VideoSequence,
    facts: CorpusFacts,
    spec: StreamSpec,
    seed: int,
    arrays: tuple[str, ...],
    number: int = 1,
    siblings: tuple[int, ...] = (),
    packed: bool = False,
) -> Lease:
    """Build the lease for one request, without the parts that the index on disk holds (``frame_index``, ``scene``).

    Args:
        request: which sample, and which candidates failed before.
        sequence: the sequence that the request's candidate is made from.
        facts, spec, seed: parts of the sample's identity.
        arrays: names of the arrays to send.
        number: the lease's number.
        siblings: indices that are made from the same clip and follow in leases of their own.
        packed: whether the consumer asks for compressed arrays.
    """
    video = sequence.video
    thresholds: tuple[float, ...] = ()
    if video.threshold_pos is not None and video.threshold_neg is not None:
        thresholds = (video.threshold_pos, video.threshold_neg)
    return Lease(
        lease=number,
        spec=spec.canonical(),
        spec_digest=spec.digest,
        catalogue_digest=facts.digest_under(spec.scene),
        seed=seed,
        epoch=request.epoch,
        indices=(request.index, *siblings),
        arrays=arrays,
        video=video.id,
        fingerprint=video.fingerprint,
        rows=str(facts.rows),
        width_px=video.width_px,
        height_px=video.height_px,
        frames_per_second=0.0 if math.isnan(video.frames_per_second) else video.frames_per_second,
        remark=video.remark,
        thresholds=thresholds,
        start_frame=sequence.start_frame,
        frame_index=b"",
        candidate=request.candidate,
        quarantine=request.snapshot,
        refusals={"refusals": [refusal.to_dict() for refusal in request.refusals]},
        arena="" if request.slot is None else request.slot.arena,
        slot=NO_SLOT if request.slot is None else request.slot.number,
        packed=packed,
        sidecars=facts.sidecars_of(video.id, arrays),
    )


def work_seconds(spec: StreamSpec, arrays: tuple[str, ...], video: VideoEntry) -> float:
    """Return an upper bound of the time for one sample, whole seconds.

    A frame of 1920 x 1080 is given 0.1 s, its flow 2 s.

    Args:
        spec, arrays: what is asked of the video.
        video: its catalogue entry; pictures are decoded whole.
    """
    recipe, picture_px = spec.recipe, video.width_px * video.height_px
    frames = int(recipe.reach_at(video.frames_per_second)) + 1
    seconds = _DECODE_SECONDS * picture_px * frames
    parts = max(frames, recipe.most_segments(frames // recipe.frame_stride))
    seconds += _SIMULATION_SECONDS * recipe.crop_height_px * recipe.crop_width_px * parts
    if needs_of(arrays).flow:
        seconds += _FLOW_SECONDS * picture_px * (frames - 1)
    return float(math.floor(seconds * spec.samples_per_decode))


def check_result(payload: Sequence[Any], request: Request, form: Form) -> SampleHeader:
    """Return the header of a result, after checking that its consumer will be able to read the sample.

    Args:
        payload: the frames behind the worker's Result: a whole SampleHeader message.
        request: what was asked.
        form: the expected form of the sample.

    Raises:
        ProtocolError: the result must not be passed on.
    """
    if not payload:
        raise ProtocolError("nothing follows it")
    header = decode(bytes(payload[0]))
    if not isinstance(header, SampleHeader) or (header.epoch, header.index) != (request.epoch, request.index):
        raise ProtocolError("its header names another sample than the lease")
    if (header.names, header.dtypes) != (form.names, form.dtypes):
        raise ProtocolError(f"it has {list(header.names)!r:.100} of {list(header.dtypes)!r:.100}")
    if header.quarantine != request.snapshot:
        raise ProtocolError(f"it was made under quarantine snapshot {header.quarantine}, not {request.snapshot}")
    slot = NO_SLOT if request.slot is None else request.slot.number
    if header.slot != slot:
        raise ProtocolError(f"it names slot {header.slot}, slot {slot} was lent")
    in_slot = slot != NO_SLOT and len(payload) == 1
    if header.shapes != form.shapes or not (in_slot or _fits(payload[1:], form.sizes, header.packed)):
        raise ProtocolError("its arrays have other shapes or sizes than the lease asks for")
    return header


def _fits(frames: Sequence[Any], sizes: tuple[int, ...], packed: bool) -> bool:
    """Return whether the frames may hold arrays of these sizes, bytes."""
    lengths = tuple(map(len, frames))
    if not packed or len(lengths) != len(sizes):
        return lengths == sizes
    return all(0 < length <= largest_packed_bytes(size) for length, size in zip(lengths, sizes, strict=True))
