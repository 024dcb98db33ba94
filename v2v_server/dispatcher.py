"""The server's mind: messages and deaths in, instructions out. No sockets, no processes, no clock.

Consumers ask (Want), sessions queue, free workers are given leases, results pass through unopened. Whatever a peer
sends, the answer is an instruction or a counted fault, never an exception: one bad peer must not stop the others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.errors import LimitExceeded, ProtocolError, UsageError, V2VError, VersionMismatch
from v2v_protocol.messages import (
    Begun,
    ErrorCode,
    Goodbye,
    Hello,
    JobFailed,
    Message,
    Ping,
    Pong,
    Refused,
    Result,
    Stop,
    Unavailable,
    Want,
    Welcome,
    WorkerHello,
)
from v2v_protocol.sample import Refusal, SampleId, array_layout, layout_bytes
from v2v_protocol.spec import StreamSpec
from v2v_protocol.wire import LARGEST_ARRAY_BYTES, Buffer, Frames, decode, encode
from v2v_server.jobs import describe
from v2v_server.leases import LeaseBook, Task
from v2v_server.metrics import Counters
from v2v_server.schedule import MOST_CANDIDATES, Schedule
from v2v_server.sequences import SequenceTable
from v2v_server.session import Session, Sessions
from v2v_server.video.catalogue import Catalogue

MOST_BLAMED_DEATHS = 2
"""A candidate that was in work while this many workers died by their own doing is passed over."""
MOST_BATCH_SIZE = 65_536
MOST_SCHEDULES = 16
"""Schedules kept for consumers to come. Each is a table over all videos; those in use live in their sessions."""
_LONGEST_TEXT = 2000
"""Characters of a text that quotes what a peer sent: unlimited, it might not fit into any message."""
_LONGEST_REASON = 500
_MOST_CPU_SECONDS = 86_400.0
"""Of one sample, whatever its worker claims: an absurd number must not unbalance the sharing for ever."""


@dataclass(frozen=True, slots=True)
class ToConsumer:
    """Send these frames to a consumer."""

    identity: bytes
    frames: Sequence[Buffer]


@dataclass(frozen=True, slots=True)
class ToWorker:
    """Send these frames to a worker."""

    identity: bytes
    frames: Frames


@dataclass(frozen=True, slots=True)
class GiveUp:
    """This worker hangs: end its process where that is in our power."""

    identity: bytes
    reason: str


Instruction: TypeAlias = ToConsumer | ToWorker | GiveUp


@dataclass(slots=True)
class _Worker:
    name: str
    credit: int
    last_heard: float


class Dispatcher:
    """Decides who gets what.

    Args:
        catalogue: the corpus.
        default_spec: what a consumer gets that asks for nothing in particular.
        lease_deadline_seconds: a worker silent for longer over one sample is taken for hung.
        session_idle_seconds: a consumer silent for longer is forgotten (it can come back).
        max_credit_bytes: bound on the bytes in flight to one consumer.

    Attributes:
        counters: what happened so far.
        sessions: the consumers.
    """

    def __init__(
        self,
        catalogue: Catalogue,
        default_spec: StreamSpec,
        *,
        lease_deadline_seconds: float,
        session_idle_seconds: float,
        max_credit_bytes: int,
    ) -> None:
        self.counters = Counters()
        self.sessions = Sessions(session_idle_seconds)
        self._catalogue = catalogue
        self._default_spec = default_spec
        self._max_credit_bytes = max_credit_bytes
        self._leases = LeaseBook(lease_deadline_seconds)
        self._workers: dict[bytes, _Worker] = {}
        self._schedules: dict[str, Schedule] = {}
        self._refusals: list[Refusal] = []

    @property
    def workers(self) -> int:
        """Workers that said hello and are alive as far as is known."""
        return len(self._workers)

    @property
    def waiting(self) -> int:
        """Asked samples that nobody works on yet."""
        return sum(len(session.waiting) for session in self.sessions)

    def take_refusals(self) -> list[Refusal]:
        """The candidates passed over since the last call, for the log."""
        taken, self._refusals = self._refusals, []
        return taken

    # --- consumers ----------------------------------------------------------------------------------------------------

    def from_consumer(self, identity: bytes, frames: Sequence[Buffer], now: float) -> list[Instruction]:
        """A message from the consumers' side."""
        try:
            message = _only(frames)
        except ProtocolError as error:
            return [ToConsumer(identity, self._malformed(error))]
        session = self.sessions.get(identity)
        if session is not None:
            session.last_heard = now
        match message:
            case Hello():
                return [self._hello(identity, message, now)]
            case Ping():
                return [ToConsumer(identity, encode(Pong()))]
            case Goodbye():
                self.consumer_lost(identity)
                return []
            case Want():
                if session is None:
                    return [_refuse(identity, ErrorCode.UNKNOWN_SESSION, "no session: say Hello (again)")]
                return self._want(session, message) or self._assign(now)
            case _:
                stray = ProtocolError(f"{type(message).__name__} is not for a consumer to send")
                return [ToConsumer(identity, self._malformed(stray))]

    def consumer_lost(self, identity: bytes) -> None:
        """The consumer left, or cannot be reached any more."""
        self.sessions.forget(identity)
        self._leases.forget_session(identity)

    def _hello(self, identity: bytes, hello: Hello, now: float) -> Instruction:
        try:
            spec = StreamSpec.from_dict(hello.spec, self._default_spec)
            layout = array_layout(spec.recipe, spec.voxel_dtype, hello.arrays)
            if not 1 <= hello.batch_size <= MOST_BATCH_SIZE:
                raise UsageError(f"batch_size = {hello.batch_size}: give 1 to {MOST_BATCH_SIZE}")
            _check_sizes(layout)
            schedule = self._schedule(spec)
        except UsageError as error:
            return _refuse(identity, ErrorCode.SPEC, str(error))
        suggested = max(2 * hello.batch_size, 2 * max(1, len(self._workers)))
        credit = max(1, min(suggested, self._max_credit_bytes // layout_bytes(layout)))
        self.consumer_lost(identity)
        self.sessions.open(
            Session(identity, spec, hello.seed, hello.arrays, hello.batch_size, schedule, credit, last_heard=now)
        )
        welcome = Welcome(
            spec=spec.to_dict(),
            spec_digest=spec.digest,
            catalogue_digest=self._catalogue.digest,
            numerics_version=NUMERICS_VERSION,
            sequences=schedule.count,
            credit=credit,
        )
        return ToConsumer(identity, encode(welcome))

    def _schedule(self, spec: StreamSpec) -> Schedule:
        schedule = self._schedules.get(spec.digest)
        if schedule is None:
            table = SequenceTable(self._catalogue.videos, self._catalogue.rows, spec)
            if not table.count:
                first = table.rejections[0]
                raise UsageError(
                    f"none of the {len(table.rejections)} videos gives a sequence; {first.video}: {first.reason} "
                    f"(would admit it: {first.remedy})"
                )
            schedule = Schedule(table, shuffle=spec.shuffle)
            while len(self._schedules) >= MOST_SCHEDULES:
                del self._schedules[next(iter(self._schedules))]
            self._schedules[spec.digest] = schedule
        return schedule

    def _want(self, session: Session, want: Want) -> list[Instruction]:
        try:
            for index in want.indices[:1]:
                SampleId(session.spec.digest, self._catalogue.digest, NUMERICS_VERSION, session.seed, want.epoch, index)
            self.sessions.want(session, want.epoch, want.indices)
        except LimitExceeded as error:
            return [_refuse(session.identity, ErrorCode.CREDIT, str(error))]
        except (IndexError, UsageError) as error:
            return [_refuse(session.identity, ErrorCode.RANGE, str(error))]
        return []

    def _malformed(self, error: ProtocolError) -> Frames:
        self.counters.malformed += 1
        code = ErrorCode.VERSION if isinstance(error, VersionMismatch) else ErrorCode.MALFORMED
        return _refused(code, str(error))

    # --- workers ------------------------------------------------------------------------------------------------------

    def from_worker(self, identity: bytes, frames: Sequence[Buffer], now: float) -> list[Instruction]:
        """A message from the workers' side. The frames behind a Result are passed on as they are."""
        try:
            message = decode(frames[0]) if frames else _only(frames)
        except ProtocolError as error:
            return [ToWorker(identity, self._malformed(error))]
        if isinstance(message, WorkerHello):
            return self._worker_hello(identity, message, now)
        worker = self._workers.get(identity)
        if worker is None:
            return [ToWorker(identity, encode(Refused(ErrorCode.UNKNOWN_SESSION, "unknown worker: say WorkerHello")))]
        worker.last_heard = now
        match message:
            case Begun(lease):
                self._leases.begun(lease, identity, now)
                return []
            case Result():
                return [*self._result(identity, message, frames[1:]), *self._assign(now)]
            case JobFailed():
                return [*self._job_failed(identity, message), *self._assign(now)]
            case Ping():
                return [ToWorker(identity, encode(Pong()))]
            case Goodbye():
                return self._take_back(identity, blame=None, now=now)
            case _:
                self.counters.malformed += 1
                return []

    def worker_lost(self, identity: bytes, blame: str | None, now: float) -> list[Instruction]:
        """A worker died or was given up.

        Args:
            identity: which worker.
            blame: why the sample it had begun is suspect (a crash, a hang), or None when it is not (killed from
                outside, disconnected).
            now: the time.
        """
        self.counters.workers_lost += 1
        return self._take_back(identity, blame, now)

    def tick(self, now: float) -> list[Instruction]:
        """To be called a few times a second: deadlines and forgotten consumers."""
        for identity in self.sessions.idle(now):
            self.consumer_lost(identity)
        instructions: list[Instruction] = []
        for overdue in self._leases.overdue(now):
            if overdue.worker in self._workers:
                reason = f"no answer over one sample for {self._leases.deadline_seconds:g} s"
                instructions.append(GiveUp(overdue.worker, reason))
                instructions += self.worker_lost(overdue.worker, reason, now)
        return instructions

    def stop_workers(self) -> list[Instruction]:
        """Tells every worker to finish and leave."""
        return [ToWorker(identity, encode(Stop())) for identity in self._workers]

    def _worker_hello(self, identity: bytes, hello: WorkerHello, now: float) -> list[Instruction]:
        if hello.numerics_version != NUMERICS_VERSION:
            text = f"worker numerics version {hello.numerics_version}, the server's is {NUMERICS_VERSION}"
            return [ToWorker(identity, encode(Refused(ErrorCode.VERSION, text)))]
        instructions = self._take_back(identity, blame=None, now=now) if identity in self._workers else []
        self._workers[identity] = _Worker(hello.name, max(1, min(hello.credit, 64)), now)
        return instructions + self._assign(now)

    def _result(self, identity: bytes, result: Result, payload: Sequence[Buffer]) -> list[Instruction]:
        task = self._leases.finished(result.lease, identity)
        if task is not None and (result.index != task.index or not payload):
            self.counters.malformed += 1
            self.sessions.put_back(task)
            return []
        cpu_seconds = min(max(result.cpu_seconds, 0.0), _MOST_CPU_SECONDS)
        if task is None or not self.sessions.answered(task, cpu_seconds):
            self.counters.late_results += 1
            return []
        size = sum(len(frame) for frame in payload)
        self.counters.samples += 1
        self.counters.bytes += size
        self.counters.worker_cpu_seconds += cpu_seconds
        session = self.sessions.get(task.session)
        if session is not None:
            self.counters.batches += 1 / session.batch_size
        return [ToConsumer(task.session, payload)]

    def _job_failed(self, identity: bytes, failed: JobFailed) -> list[Instruction]:
        task = self._leases.finished(failed.lease, identity)
        return [] if task is None else self._refuse_candidate(task, failed.frame, failed.reason)

    def _take_back(self, identity: bytes, blame: str | None, now: float) -> list[Instruction]:
        self._workers.pop(identity, None)
        instructions: list[Instruction] = []
        returned = self._leases.lost(identity)
        self.counters.returned_leases += len(returned)
        for task, begun in reversed(returned):
            if begun and blame is not None:
                blamed = replace(task, deaths=task.deaths + 1)
                if blamed.deaths >= MOST_BLAMED_DEATHS:
                    instructions += self._refuse_candidate(blamed, None, blame)
                    continue
                task = blamed
            self.sessions.put_back(task)
        return instructions + self._assign(now)

    # --- tasks --------------------------------------------------------------------------------------------------------

    def _refuse_candidate(self, task: Task, frame: int | None, reason: str) -> list[Instruction]:
        """The task's candidate cannot be used: on to the next, or to the consumer with the whole story."""
        session = self.sessions.get(task.session)
        if session is None:
            return []
        self.counters.refused_candidates += 1
        sequence = session.schedule.candidate(session.seed, task.epoch, task.index, task.candidate)
        refusal = Refusal(task.candidate, sequence.video.id, frame, reason[:_LONGEST_REASON])
        self._refusals.append(refusal)
        refusals = (*task.refusals, refusal)
        candidate = task.candidate + 1
        if candidate < MOST_CANDIDATES and session.spec.on_bad_video == "substitute":
            self.sessions.put_back(replace(task, candidate=candidate, refusals=refusals, deaths=0))
            return []
        if not self.sessions.answered(task, 0.0):
            return []
        self.counters.unavailable += 1
        text = "; ".join(map(str, refusals))
        return [ToConsumer(task.session, encode(Unavailable(task.epoch, task.index, text)))]

    def _assign(self, now: float) -> list[Instruction]:
        """Gives waiting tasks to the workers with the most room."""
        instructions: list[Instruction] = []
        while True:
            free = [
                (self._leases.held_by(identity), identity)
                for identity, worker in self._workers.items()
                if self._leases.held_by(identity) < worker.credit
            ]
            task = self.sessions.next_task() if free else None
            if task is None:
                return instructions
            session = self.sessions.get(task.session)
            if session is None:
                continue
            _, identity = min(free)
            number = self._leases.grant(task, identity, now)
            try:
                lease = describe(
                    task,
                    number=number,
                    catalogue=self._catalogue,
                    schedule=session.schedule,
                    spec=session.spec,
                    seed=session.seed,
                    arrays=session.arrays,
                    deadline_seconds=self._leases.deadline_seconds,
                )
                instructions.append(ToWorker(identity, encode(lease)))
            except V2VError as error:
                # The index of one video cannot be read, or is too large to send: that video's fault, nobody else's.
                self._leases.finished(number, identity)
                instructions += self._refuse_candidate(task, None, str(error))


def _only(frames: Sequence[Buffer]) -> Message:
    if len(frames) != 1:
        raise ProtocolError(f"a message of {len(frames)} frames; this kind has one")
    return decode(frames[0])


def _check_sizes(layout: Mapping[str, tuple[str, tuple[int, ...]]]) -> None:
    for name, (dtype, shape) in layout.items():
        size = layout_bytes({name: (dtype, shape)})
        if size > LARGEST_ARRAY_BYTES:
            raise UsageError(
                f"array {name} {dtype}{list(shape)} of one sample is {size} bytes; the limit is {LARGEST_ARRAY_BYTES}: "
                f"ask for fewer voxels_per_clip or a smaller crop"
            )


def _refused(code: ErrorCode, text: str) -> Frames:
    return encode(Refused(code, text if len(text) <= _LONGEST_TEXT else text[:_LONGEST_TEXT] + " ..."))


def _refuse(identity: bytes, code: ErrorCode, text: str) -> ToConsumer:
    return ToConsumer(identity, _refused(code, text))
