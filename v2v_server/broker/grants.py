"""Choose what each waiting request is made from, give it to a free worker, and check the worker's result. No I/O; time
is passed in.

A candidate is refused because its video failed, because it brought a worker down (written to the quarantine first), or
because it already is in quarantine. The refusals travel with the request into the sample's provenance.

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
from v2v_protocol.errors import IndexUnreadable, ProtocolError, V2VError
from v2v_protocol.messages import Lease, SampleHeader, Unavailable, decode, encode, largest_packed_bytes
from v2v_protocol.sample import Form, Refusal, RefusalKind
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.leases import Request, bounded_seconds, runs_alone
from v2v_server.broker.session import Session
from v2v_server.broker.state import (
    Action,
    AddToQuarantine,
    Broker,
    CheckVideo,
    RefusalPart,
    ReportRefusal,
    ToConsumer,
    ToWorker,
)
from v2v_server.corpus.videos import CorpusFacts, VideoEntry
from v2v_server.quarantine import QuarantineEntry
from v2v_server.schedule import MOST_CANDIDATES, VideoSequence
from v2v_server.sharing import SharedSample

LONGEST_REASON = 500
"""Characters kept of a refusal's reason."""
_DECODE_SECONDS = 5e-8
"""For each pixel of a frame: ten times the time of a slow codec on a slow core. The other limits are as generous."""
_FLOW_SECONDS = 1e-6
_SIMULATION_SECONDS = 1e-7


def _quarantined(broker: Broker, session: Session, request: Request, snapshot: int) -> str | None:
    """Return why the request's candidate is refused under a snapshot; None if it is not."""
    sequence = session.sequence(request)
    video = sequence.video
    return broker.quarantine.refusal(snapshot, video.id, video.fingerprint, sequence.start_frame, session.spec.digest)


def quarantine_candidate(broker: Broker, request: Request, reason: str, *, for_all: bool = True) -> list[Action]:
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
        return refuse_quarantined(broker, request, reason)
    sequence = session.sequence(request)
    video, text = sequence.video, reason[:LONGEST_REASON]
    spec, time = "" if for_all else session.spec.digest, broker.wall_clock()
    return [
        AddToQuarantine(
            QuarantineEntry(0, video.id, video.fingerprint, sequence.start_frame, text, time, spec), request
        )
    ]


def refuse_quarantined(broker: Broker, request: Request, reason: str) -> list[Action]:
    """Move the request to its next candidate. If the session's snapshot holds the entry, the refusal comes from the
    quarantine, which a later remake finds as well; otherwise it states what happened.
    """
    session = broker.sessions.get(request.session)
    if session is None:
        return []
    if _quarantined(broker, session, request, session.quarantine) is None:
        return refuse(broker, request, None, reason)
    broker.sessions.put_back(replace(request, deaths=0))
    return []


def refuse(
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
    return [*actions, *fail(broker, request, "; ".join(dict.fromkeys(map(str, passed_over.refusals))))]


def blame(broker: Broker, failure: CheckVideo) -> list[Action]:
    """Refuse a video. A sidecar never changes which video is shown: its consumer gets an error instead."""
    if failure.sidecar:
        return fail(broker, failure.request, f"{failure.video}: its sidecar {failure.sidecar}: {failure.reason}")
    return refuse(broker, failure.request, failure.frame, failure.reason)


def fail(broker: Broker, request: Request, text: str) -> list[Action]:
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


def forget_session(broker: Broker, session: bytes) -> None:
    """Drop the requests of a consumer that is gone, and abandon its leases."""
    broker.leases.forget_session(session)
    broker.lone = deque(request for request in broker.lone if request.session != session)
    for key, followers in broker.followers.items():
        broker.followers[key] = [request for request in followers if request.session != session]


def assign(broker: Broker, now: float) -> list[Action]:
    """Give waiting requests to workers until there are no requests or no free workers."""
    actions: list[Action] = []
    _release_followers(broker)
    while not broker.blocked_reason:
        if broker.lone:
            empty = broker.registry.for_lone_request()
            if empty is not None:
                actions += _give(broker, [broker.lone.popleft()], empty, now)
                continue
        worker = broker.registry.for_request(keep_one_empty=bool(broker.lone))
        request = broker.sessions.next_request() if worker is not None else None
        if worker is None or request is None:
            return actions
        if runs_alone(request):
            broker.lone.append(request)
        else:
            actions += _give(broker, [request, *broker.sessions.take_siblings(request)], worker, now)
    return actions


def assign_slow(broker: Broker, now: float) -> list[Action]:
    """Give requests that take unusually long to a second worker each."""
    actions: list[Action] = []
    for request, worker in broker.leases.slow(now):
        second = broker.registry.for_request(keep_one_empty=bool(broker.lone), other_than=worker)
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
            actions += refuse(broker, current, None, reason, RefusalKind.QUARANTINED)
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
        as_leased(broker, request, number),
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
        return [ToWorker(worker, encode(broker.complete(lease, session.spec)), lease.arena)]
    except V2VError as error:
        broker.leases.finished(number, worker, now)
        if not isinstance(error, IndexUnreadable):
            return refuse(broker, request, None, str(error))
        broker.blocked_reason = f"{error}; retried ten times a second"
        return None


# --- sharing ------------------------------------------------------------------------------------------------------


def as_leased(broker: Broker, request: Request, lease: int) -> Request:
    """Return a request with the slot that its lease names.

    Without a ring that is its own. With one it is the memory lent for this lease, or none: the ring needs the
    arrays.
    """
    return request if broker.ring is None else replace(request, slot=broker.ring.lent(lease))


def answer_shared(broker: Broker, session: Session) -> list[Action]:
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


def deliver(
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
    if not packed or len(lengths) != len(sizes):
        return lengths == sizes
    return all(0 < length <= largest_packed_bytes(size) for length, size in zip(lengths, sizes, strict=True))
