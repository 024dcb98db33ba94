"""Give waiting requests to free workers, and check the workers' results. No I/O; time is passed in.

A lease holds everything that a worker on any host needs, and nothing else. Its result is checked before it is passed
on: a consumer trusts its server, but the server does not trust a worker, which may run another version, be broken or be
hostile. Only the small header is read. The arrays are measured, unless they lie in a slot.

With a ring, equal samples are made once. A request for one that is being made follows its *maker*, the request that has
the lease; one in the ring is answered at once. If the maker's lease ends without a sample, its followers wait again.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Hashable, Sequence
from dataclasses import replace
from typing import Any

from v2v_protocol.arena import NO_SLOT
from v2v_protocol.errors import ProtocolError
from v2v_protocol.messages import Lease, SampleHeader, decode, largest_packed_bytes
from v2v_protocol.sample import Form, RefusalKind
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.actions import Action, SendLease, ToConsumer
from v2v_server.broker.candidates import Candidates
from v2v_server.broker.counters import Counters
from v2v_server.broker.leases import LeaseBook, Request, runs_alone
from v2v_server.broker.session import Session, Sessions
from v2v_server.broker.worker_registry import Workers
from v2v_server.corpus.videos import CorpusFacts, VideoEntry
from v2v_server.schedule.sequences import VideoSequence
from v2v_server.sharing.ring import SampleRing, SharedSample


class Grants:
    """Give each waiting request to the free worker with the fewest leases.

    Attributes:
        blocked_reason: why no lease can be granted at the moment; empty if leases can be granted.
        lone: requests that run alone and wait for a worker without leases.

    Args:
        ring: finished samples for other consumers; None: equal samples are made for each.
    """

    def __init__(
        self,
        facts: CorpusFacts,
        sessions: Sessions,
        leases: LeaseBook,
        registry: Workers,
        candidates: Candidates,
        counters: Counters,
        ring: SampleRing | None = None,
    ) -> None:
        self._facts = facts
        self._sessions = sessions
        self._leases = leases
        self._registry = registry
        self._candidates = candidates
        self._counters = counters
        self._ring = ring
        self._makers: dict[Hashable, tuple[bytes, int, int]] = {}
        self._followers: dict[Hashable, list[Request]] = {}
        self.blocked_reason = ""
        self.lone: deque[Request] = deque()

    def forget_session(self, session: bytes) -> None:
        """Drop the requests of a consumer that is gone, and abandon its leases."""
        self._leases.forget_session(session)
        self.lone = deque(request for request in self.lone if request.session != session)
        for key, followers in self._followers.items():
            self._followers[key] = [request for request in followers if request.session != session]

    def assign(self, now: float) -> list[Action]:
        """Give waiting requests to workers until there are no requests or no free workers."""
        actions: list[Action] = []
        self._release_followers()
        while not self.blocked_reason:
            if self.lone:
                empty = self._registry.for_lone_request()
                if empty is not None:
                    actions += self._give([self.lone.popleft()], empty, now)
                    continue
            worker = self._registry.for_request(keep_one_empty=bool(self.lone))
            request = self._sessions.next_request() if worker is not None else None
            if worker is None or request is None:
                return actions
            if runs_alone(request):
                self.lone.append(request)
            else:
                actions += self._give([request, *self._sessions.take_siblings(request)], worker, now)
        return actions

    def assign_slow(self, now: float) -> list[Action]:
        """Give requests that take unusually long to a second worker each."""
        actions: list[Action] = []
        for request, worker in self._leases.slow(now):
            second = self._registry.for_request(keep_one_empty=bool(self.lone), other_than=worker)
            if second is not None and not runs_alone(request):
                actions += self._grant(replace(request, slot=None), second, now)
        return actions

    def take_back(self, unsent: Sequence[SendLease], now: float) -> None:
        """Take back leases that could not be completed at the moment; their consumers' requests come first again."""
        for grant in reversed(unsent):
            request = self._leases.finished(grant.lease.lease, grant.worker, now)
            if request is not None:
                self._sessions.put_back(request)

    def refuse(self, unsent: SendLease, reason: str, now: float) -> list[Action]:
        """Refuse the candidate of a lease that can never be sent; other videos are not affected."""
        request = self._leases.finished(unsent.lease.lease, unsent.worker, now)
        return [] if request is None else self._candidates.refuse(request, None, reason)

    def _give(self, requests: list[Request], worker: bytes, now: float) -> list[Action]:
        """Give a worker the requests of one clip, except those whose candidate is in quarantine."""
        session = self._sessions.get(requests[0].session)
        if session is None:
            return []
        actions: list[Action] = []
        good: list[Request] = []
        for request in requests:
            current = self._candidates.current(request, session)
            quarantined = self._candidates.quarantined(session, current, session.quarantine)
            if quarantined is not None:
                actions += self._candidates.refuse(current, None, quarantined, RefusalKind.QUARANTINED)
            elif (answer := self._share(session, current)) is not None:
                actions += answer
            else:
                good.append(current)
        for place, request in enumerate(good):
            actions += self._grant(request, worker, now, tuple(other.index for other in good[place + 1 :]))
        return actions

    def _grant(self, request: Request, worker: bytes, now: float, siblings: tuple[int, ...] = ()) -> list[Action]:
        session = self._sessions.get(request.session)
        if session is None:
            return []
        sequence = self._candidates.sequence(session, request)
        seconds = work_seconds(session.spec, session.arrays, sequence.video)
        number = self._leases.grant(request, worker, now, seconds)
        if self._ring is not None:
            self._makers[sharing_key(session, request)] = request.sample
            # A consumer without a slot is on another host, as far as is known, and gets a message.
            if request.slot is not None and not session.packed:
                self._ring.lend(number, session.form.sizes)
        lease = lease_for(
            self.as_leased(request, number),
            number=number,
            sequence=sequence,
            facts=self._facts,
            spec=session.spec,
            seed=session.seed,
            arrays=session.arrays,
            siblings=siblings,
            packed=session.packed,
        )
        return [SendLease(worker, lease, session.spec)]

    # --- sharing ------------------------------------------------------------------------------------------------------

    def as_leased(self, request: Request, lease: int) -> Request:
        """Return a request with the slot that its lease names.

        Without a ring that is its own. With one it is the memory lent for this lease, or none: the ring needs the
        arrays.
        """
        return request if self._ring is None else replace(request, slot=self._ring.lent(lease))

    def answer_shared(self, session: Session) -> list[Action]:
        """Answer waiting requests whose samples are in the ring, and let those that are being made follow."""
        if self._ring is None:
            return []
        actions: list[Action] = []
        taken, room = set[Request](), self._sessions.room(session)
        for request in list(session.waiting):
            if (
                len(taken) < room
                and (answer := self._share(session, self._candidates.current(request, session))) is not None
            ):
                actions += answer
                taken.add(request)
        self._sessions.take_waiting(session, taken)
        return actions

    def deliver(
        self, session: Session, request: Request, lease: int, header: SampleHeader, payload: Sequence[Any]
    ) -> list[Action]:
        """Send a finished sample to its consumer, and to those that wait for an equal one.

        Args:
            session, request: the consumer and the request that it was made for.
            lease: number of the lease.
            header: of the sample.
            payload: the frames of its message, with the header's.
        """
        if self._ring is None:
            return [ToConsumer(request.session, payload)]
        key = sharing_key(session, request)
        sample = self._ring.add(key, lease, header, payload[1:])
        self._makers.pop(key, None)
        actions: list[Action] = [ToConsumer(request.session, sample.message(request.slot, is_first=True))]
        for follower in self._followers.pop(key, ()):
            actions += self._send_shared(follower, sample)
        return actions

    def _share(self, session: Session, request: Request) -> list[Action] | None:
        """Answer a request from the ring, or let it wait for the lease that makes its sample; else return None."""
        if self._ring is None:
            return None
        key = sharing_key(session, request)
        sample = self._ring.get(key)
        if sample is not None:
            return self._send_shared(request, sample)
        maker = self._makers.get(key)
        if maker is None or not self._leases.is_out(maker):
            return None
        self._followers.setdefault(key, []).append(request)
        return []

    def _send_shared(self, request: Request, sample: SharedSample) -> list[Action]:
        session = self._sessions.get(request.session)
        if session is None or not self._sessions.mark_answered(request, 0.0):
            return []
        in_slot = sample.memory is not None and request.slot is not None
        self._counters.count_sent(session.batch_size, session.form.sizes, in_slot=in_slot)
        self._counters.samples += 1
        self._counters.shared += 1
        return [ToConsumer(request.session, sample.message(request.slot, is_first=False))]

    def _release_followers(self) -> None:
        """Queue the followers of makers without a lease again, and free the memory of leases that have ended."""
        if self._ring is None:
            return
        self._ring.release(self._leases)
        for key in [key for key, maker in self._makers.items() if not self._leases.is_out(maker)]:
            del self._makers[key]
            for request in reversed(self._followers.pop(key, [])):
                self._sessions.put_back(request)


def sharing_key(session: Session, request: Request) -> Hashable:
    """Return a key that is equal for requests whose samples, provenance included, are equal byte for byte and whose
    consumers have the same key.
    """
    return (
        session.user, session.spec.digest, session.seed, session.arrays, session.packed,
        request.epoch, request.index, request.candidate, request.refusals, request.snapshot,
    )  # fmt: skip


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


_DECODE_SECONDS = 5e-8
"""For each pixel of a frame: ten times the time of a slow codec on a slow core. The other limits are as generous."""
_FLOW_SECONDS = 1e-6
_SIMULATION_SECONDS = 1e-7


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
    if not {"flow", "flow_valid"}.isdisjoint(arrays):
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
    if not packed:
        return lengths == sizes
    if len(lengths) != len(sizes):
        return False
    return all(0 < length <= largest_packed_bytes(size) for length, size in zip(lengths, sizes, strict=True))
