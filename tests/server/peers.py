"""Fake consumers and workers around a dispatcher, and a post office that carries its actions out."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

from tests.server.named_corpus import SMALL_SPEC, corpus, video
from v2v_protocol import NUMERICS_VERSION
from v2v_protocol.arena import NO_SLOT
from v2v_protocol.errors import IndexUnreadable, V2VError
from v2v_protocol.messages import (
    Begun,
    Buffer,
    Denied,
    Hello,
    Lease,
    LeaseFailed,
    Message,
    Notes,
    Result,
    SampleHeader,
    Unavailable,
    Want,
    Welcome,
    WorkerHello,
    decode,
    encode,
    encode_map,
)
from v2v_protocol.sample import Refusal, array_layout, layout_bytes
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.dispatcher import Dispatcher
from v2v_server.broker.leases import Cause, Loss
from v2v_server.broker.state import (
    Action,
    AddToQuarantine,
    Broker,
    CheckVideo,
    GiveUp,
    Grant,
    ReportRefusal,
    ToConsumer,
    ToWorker,
)
from v2v_server.corpus.catalogue import Catalogue, complete_lease
from v2v_server.quarantine import Quarantine, QuarantineEntry

DEADLINE = 60.0
IDLE = 600.0
CREDIT = 2
"""Leases a fake worker holds at a time, as the real one does."""


def sample_frames(epoch: int, index: int, seed: int = 0) -> list[Buffer]:
    """A whole SampleHeader message for SMALL_SPEC; its provenance says for which seed it was made."""
    return frames_of(array_layout(SMALL_SPEC.recipe, "int8", ("voxels",)), epoch, index, seed)


@cache
def spec_of(encoded: bytes) -> StreamSpec:
    """Decode a spec; a test repeats few of them often."""
    return StreamSpec.from_dict(json.loads(encoded))


def answer_to(lease: Lease, *, in_slot: bool = False, cpu_seconds: float = 0.1, decoded: bool = True) -> list[Buffer]:
    """What an honest worker sends behind its Result."""
    spec = spec_of(lease.spec)
    layout = array_layout(spec.recipe, spec.voxel_dtype, lease.arrays)
    frames = frames_of(
        layout, lease.epoch, lease.indices[0], lease.seed, lease.slot, cpu_seconds, lease.quarantine, decoded
    )
    return frames[:1] if in_slot else frames


def frames_of(
    layout: Mapping[str, tuple[str, tuple[int, ...]]],
    epoch: int,
    index: int,
    seed: int,
    slot: int = NO_SLOT,
    cpu_seconds: float = 0.1,
    quarantine: int = 0,
    decoded: bool = True,
) -> list[Buffer]:
    """A sample message of zeros in that layout."""
    header = SampleHeader(
        epoch=epoch,
        index=index,
        names=tuple(layout),
        dtypes=tuple(dtype for dtype, _ in layout.values()),
        shapes=tuple(extent for _, shape in layout.values() for extent in (len(shape), *shape)),
        provenance=encode_map({"seed": seed}),
        worker="w",
        cpu_seconds=cpu_seconds,
        decoded=decoded,
        slot=slot,
        quarantine=quarantine,
    )
    return [*encode(header), *(memoryview(bytes(layout_bytes({name: layout[name]}))) for name in layout)]


@dataclass
class Peers:
    """A dispatcher and everybody who talks to it.

    Attributes:
        dispatcher: the one under test.
        catalogue: the videos that it serves.
        now: the time everybody agrees on.
        frames: what each consumer was sent, in raw frames.
        heard: the same, decoded.
        leases: what each worker holds, oldest first; a worker works in this order.
        owners: the consumer that each lease's sample is for.
        told: what else each worker was told.
        given_up: workers that were to be killed.
        remote: workers that cannot be killed, as on another host; what they hold stays with them.
        quarantine: the snapshots.
        writable: whether verdicts can be written down.
        recorded: verdicts that were to be written down.
        others: lines that somebody else writes before the next verdict, numbered.
        gone: videos that the server's host has not either.
        passed_over: what the operator was told of.
        sent: kinds of all actions in the order they were carried out, with what they were about.
    """

    dispatcher: Dispatcher
    catalogue: Catalogue
    quarantine: Quarantine
    now: float = 0.0
    frames: dict[bytes, list[Sequence[Buffer]]] = field(default_factory=dict)
    heard: dict[bytes, list[Message]] = field(default_factory=dict)
    leases: dict[bytes, deque[Lease]] = field(default_factory=dict)
    owners: dict[int, bytes] = field(default_factory=dict)
    told: dict[bytes, list[Message]] = field(default_factory=dict)
    given_up: list[bytes] = field(default_factory=list)
    remote: set[bytes] = field(default_factory=set)
    writable: bool = True
    recorded: list[QuarantineEntry] = field(default_factory=list)
    others: list[QuarantineEntry] = field(default_factory=list)
    gone: set[str] = field(default_factory=set)
    passed_over: list[Refusal] = field(default_factory=list)
    sent: list[tuple[str, Any]] = field(default_factory=list)

    @property
    def broker(self) -> Broker:
        return self.dispatcher.broker

    # --- carrying -----------------------------------------------------------------------------------------------------

    def carry_out(self, actions: list[Action]) -> None:
        """As the loop does it, in its order."""
        todo = deque(actions)
        while todo:
            match todo.popleft():
                case ToConsumer(identity, frames):
                    message = decode(frames[0])
                    self.sent.append(("to consumer", message))
                    self.frames.setdefault(identity, []).append(frames)
                    self.heard.setdefault(identity, []).append(message)
                case ToWorker(identity, frames):
                    message = decode(frames[0])
                    self.sent.append(("to worker", message))
                    if isinstance(message, Lease):
                        self.leases.setdefault(identity, deque()).append(message)
                        asked = self.broker.leases.request(message.lease, identity)
                        self.owners[message.lease] = b"" if asked is None else asked.session
                    else:
                        self.told.setdefault(identity, []).append(message)
                case Grant() as grant:
                    try:
                        todo.extend(grant.messages(complete_lease(grant.leases[0], self.catalogue, grant.spec)))
                    except IndexUnreadable as error:  # none of the others can be completed either
                        grants = [grant, *(each for each in todo if isinstance(each, Grant))]
                        todo = deque(each for each in todo if not isinstance(each, Grant))
                        todo.extend(self.dispatcher.not_granted(grants, error, self.now))
                    except V2VError as error:
                        todo.extend(self.dispatcher.not_granted([grant], error, self.now))
                case GiveUp(identity, reason):
                    self.given_up.append(identity)
                    cause = Cause.UNEXPLAINED if identity in self.remote else Cause.HUNG
                    todo.extend(self.dispatcher.worker_lost(identity, Loss(cause, reason), self.now))
                case AddToQuarantine() as record:
                    self.sent.append(("record", record.entry))
                    todo.extendleft(
                        reversed(self.dispatcher.quarantine_recorded(record, self._write(record.entry), self.now))
                    )
                case ReportRefusal(refusal):
                    self.passed_over.append(refusal)
                case CheckVideo() as missing:
                    found = missing.video not in self.gone
                    todo.extend(self.dispatcher.video_checked(missing, found, self.now))

    def _write(self, verdict: QuarantineEntry) -> list[QuarantineEntry]:
        if not self.writable:
            return []
        others, self.others = self.others, []
        numbered = replace(verdict, snapshot=self.quarantine.latest + len(others) + 1)
        self.recorded.append(numbered)
        return [*others, numbered]

    def consumer_says(self, identity: bytes, message: Message) -> list[Message]:
        """Sends a consumer's message; returns what that consumer heard in reply."""
        before = len(self.heard.get(identity, []))
        self.carry_out(self.dispatcher.from_consumer(identity, encode(message), self.now))
        return self.heard.get(identity, [])[before:]

    def worker_says(self, identity: bytes, message: Message, *payload: Buffer) -> None:
        self.carry_out(self.dispatcher.from_worker(identity, [*encode(message), *payload], self.now))

    def tick(self, seconds: float) -> None:
        self.now += seconds
        self.carry_out(self.dispatcher.tick(self.now))

    # --- what peers do ------------------------------------------------------------------------------------------------

    def hello(
        self,
        identity: bytes = b"c",
        *,
        batch_size: int = 4,
        seed: int = 0,
        quarantine: int | None = None,
        **spec: Any,
    ) -> Welcome:
        (welcome,) = self.consumer_says(identity, Hello(spec, ("voxels",), batch_size, seed, quarantine))
        if not isinstance(welcome, Welcome):
            raise AssertionError(welcome)
        return welcome

    def want(
        self, *indices: int, identity: bytes = b"c", epoch: int = 0, arena: str = "", slots: Sequence[int] = ()
    ) -> list[Message]:
        return self.consumer_says(identity, Want(epoch, indices, (arena,) * len(slots), tuple(slots)))

    def join(self, identity: bytes = b"w", credit: int = CREDIT, memory_bytes: int = 0) -> None:
        self.leases[identity] = deque()
        notes = Notes(memory_bytes=memory_bytes)
        self.worker_says(identity, WorkerHello(identity.decode(), NUMERICS_VERSION, credit, notes=notes))

    def asked_by(self, lease: Lease) -> bytes:
        """The consumer that a lease's sample is for, which its worker is not told."""
        return self.owners[lease.lease]

    def begin(self, identity: bytes = b"w") -> Lease:
        lease = self.leases[identity][0]
        self.worker_says(identity, Begun(lease.lease))
        return lease

    def finish(
        self,
        identity: bytes = b"w",
        cpu_seconds: float = 0.1,
        *,
        in_slot: bool = False,
        begins: int = 0,
        decoded: bool = True,
    ) -> Lease:
        """Answers the oldest lease, in its slot if asked to and it has one, and says what it begins next."""
        lease = self.leases[identity].popleft()
        in_slot = in_slot and lease.slot != NO_SLOT
        frames = answer_to(lease, in_slot=in_slot, cpu_seconds=cpu_seconds, decoded=decoded)
        self.worker_says(identity, Result(lease.lease, begins), *frames)
        return lease

    def fail(
        self,
        identity: bytes = b"w",
        reason: str = "cut short",
        frame: int | None = 7,
        *,
        here: bool = False,
        sidecar: str = "",
    ) -> Lease:
        lease = self.leases[identity].popleft()
        self.worker_says(identity, LeaseFailed(lease.lease, frame, reason, here, sidecar))
        return lease

    def die(self, identity: bytes = b"w", cause: Cause = Cause.KILLED, text: str = "died") -> list[Lease]:
        """The worker's process ends; returns the leases it held."""
        held = list(self.leases.pop(identity, ()))
        self.carry_out(self.dispatcher.worker_lost(identity, Loss(cause, text), self.now))
        return held

    def work_off(self, identity: bytes = b"w") -> None:
        """The worker finishes everything it is given."""
        while self.leases[identity]:
            self.begin(identity)
            self.finish(identity)

    # --- what came of it ----------------------------------------------------------------------------------------------

    def samples(self, identity: bytes = b"c") -> list[tuple[int, int]]:
        """(epoch, index) of the samples a consumer got."""
        return [(m.epoch, m.index) for m in self.heard.get(identity, []) if isinstance(m, SampleHeader)]

    def unavailable(self, identity: bytes = b"c") -> list[Unavailable]:
        return [message for message in self.heard.get(identity, []) if isinstance(message, Unavailable)]

    def refusals(self, identity: bytes = b"c") -> list[Denied]:
        return [message for message in self.heard.get(identity, []) if isinstance(message, Denied)]


def peers(
    catalogue: Catalogue | None = None,
    spec: StreamSpec = SMALL_SPEC,
    max_credit_bytes: int = 2 << 30,
    quarantine: Quarantine | None = None,
    expected_workers: int = 0,
    share_bytes: int = 0,
) -> Peers:
    """Return a dispatcher over a small corpus, or over the given one, without connected peers."""
    videos = catalogue or corpus(*(video(f"v{number}.mp4") for number in range(5)))
    held = Quarantine() if quarantine is None else quarantine
    broker = Broker(
        videos.facts,
        spec,
        lease_deadline_seconds=DEADLINE,
        session_idle_seconds=IDLE,
        max_credit_bytes=max_credit_bytes,
        quarantine=held,
        wall_clock=lambda: "2024-02-29T12:00:00+00:00",
        expected_workers=expected_workers,
        share_bytes=share_bytes,
    )
    return Peers(Dispatcher(broker), videos, held)


def serving(*indices: int, worker: bytes = b"w", credit: int = CREDIT, **hello: Any) -> Peers:
    """Return a dispatcher with a worker, and a consumer that has asked for these indices."""
    at = peers()
    at.join(worker, credit)
    at.hello(**hello)
    at.want(*indices)
    return at
