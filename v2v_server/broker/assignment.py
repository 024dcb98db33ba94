"""Give waiting requests to workers: which worker suits a clip, by its leases and memory, and the leases that it gets.

A lease holds everything that a worker on any host needs, and nothing else. The loop adds what the index on disk holds
of its clip, or gives it back.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import replace

from v2v_protocol.arena import NO_SLOT
from v2v_protocol.errors import IndexUnreadable, V2VError
from v2v_protocol.messages import Lease
from v2v_protocol.sample import RefusalKind, needs_of
from v2v_protocol.spec import StreamSpec
from v2v_server.broker.candidates import fail, quarantine_reason, refuse
from v2v_server.broker.leases import Request, runs_alone
from v2v_server.broker.session import Session
from v2v_server.broker.shared import lend_memory, release_followers, share
from v2v_server.broker.state import Action, Broker, Grant, ParkedClip
from v2v_server.corpus.videos import CorpusFacts, VideoEntry
from v2v_server.lease_memory import LARGEST_MEMORY_BYTES, lease_bytes
from v2v_server.schedule import VideoSequence

TOO_LARGE_SECONDS = 5.0
"""Time after which a sample that takes more memory than every worker has is an error."""
_DECODE_SECONDS = 5e-8
"""For each pixel of a frame: ten times the time of a slow codec on a slow core. The other limits are as generous."""
_FLOW_SECONDS = 1e-6
_SIMULATION_SECONDS = 1e-7


def assign(broker: Broker, now: float) -> list[Action]:
    """Give waiting requests to workers until there are no requests or no free workers. Give none while leases are
    blocked.
    """
    actions: list[Action] = []
    release_followers(broker)
    while not broker.blocked_reason:
        suited = ((clip, worker) for clip in broker.parked if (worker := _worker_for(broker, clip)) is not None)
        if (found := next(suited, None)) is not None:
            clip, worker = found
            broker.parked.remove(clip)
            actions += _give(broker, clip.requests, worker, now)
            continue
        request = broker.sessions.next_request() if broker.registry.for_request(kept_bytes=_kept(broker)) else None
        if request is None:
            break
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


def assign_slow(broker: Broker, now: float) -> list[Action]:
    """Give requests that take unusually long to a second worker each."""
    actions: list[Action] = []
    for request, worker in broker.leases.slow(now):
        second = broker.registry.for_request(
            kept_bytes=_kept(broker), other_than=worker, needs_bytes=needed_bytes(broker, request)
        )
        session = broker.sessions.get(request.session)
        if session is not None and second is not None and not runs_alone(request):
            slotless = replace(request, slot=None)  # the first worker may still write to the slot
            actions.append(_grant(broker, session, [slotless], second, now))
    broker.counters.second_leases += len(actions)
    return actions


def _give(broker: Broker, requests: list[Request], worker: bytes, now: float) -> list[Action]:
    """Give a worker the requests of one clip, unless its candidate is in quarantine."""
    session = broker.sessions.get(requests[0].session)
    if session is None:
        return []
    requests = [session.current(request) for request in requests]
    reason = quarantine_reason(broker, session, requests[0], session.quarantine)
    actions: list[Action] = []
    if reason is not None:
        for request in reversed(requests):  # siblings keep their order
            actions += refuse(broker, request, None, reason, RefusalKind.QUARANTINED)
        return actions
    alone: list[Request] = []
    for request in requests:
        if (answer := share(broker, session, request)) is None:
            alone.append(request)
        else:
            actions += answer
    return [*actions, _grant(broker, session, alone, worker, now)] if alone else actions


def _grant(broker: Broker, session: Session, requests: list[Request], worker: bytes, now: float) -> Grant:
    """Lease the requests of one clip to a worker."""
    sequence = session.sequence(requests[0])
    seconds = work_seconds(session.spec, session.arrays, sequence.video)
    indices = tuple(request.index for request in requests)
    leases: list[Lease] = []
    for request in requests:
        number = broker.leases.grant(request, worker, now, seconds)
        lease = lease_for(
            lend_memory(broker, session, request, number),
            number=number,
            sequence=sequence,
            facts=broker.facts,
            spec=session.spec,
            seed=session.seed,
            arrays=session.arrays,
            siblings=indices[len(leases) + 1 :],
            packed=session.packed,
        )
        leases.append(lease)
    return Grant(worker, tuple(leases), session.spec, broker.registry.members[worker].takes_notes)


def take_back(broker: Broker, grants: Sequence[Grant], error: V2VError) -> list[Action]:
    """Take back leases that were not completed, and so not sent.

    Args:
        grants: in their order. The requests go back in reverse order, so that siblings keep theirs.
        error: why the first of them could not be completed. If the index cannot be read at the moment, the requests
            wait, and no lease is granted until the next tick. Else their candidate is refused.
    """
    if is_blocked := isinstance(error, IndexUnreadable):
        broker.blocked_reason = f"{error}; retried ten times a second"
    actions: list[Action] = []
    for lease in reversed([lease for grant in grants for lease in grant.leases]):
        request = broker.leases.recall(lease.lease)
        if request is None:
            continue
        if request.sample in broker.leases.out:  # the first worker still makes it
            broker.counters.second_leases -= 1
        elif is_blocked:
            broker.sessions.put_back(request)
        else:
            actions += refuse(broker, request, None, str(error))
    return actions


# --- the lease --------------------------------------------------------------------------------------------------------


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
    frames = int(recipe.held_at(video.frames_per_second)) + 1
    seconds = _DECODE_SECONDS * picture_px * frames
    parts = max(frames, recipe.most_segments(frames // recipe.frame_stride))
    seconds += _SIMULATION_SECONDS * recipe.crop_height_px * recipe.crop_width_px * parts
    if needs_of(arrays).flow:
        seconds += _FLOW_SECONDS * picture_px * (frames - 1)
    return float(math.floor(seconds * spec.samples_per_decode))


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


def mark_outgrown(broker: Broker, request: Request, limit_bytes: int) -> None:
    """Note that a clip needs more memory than a worker had, which made nothing else and was killed at its limit.

    It is never put into quarantine: another server may have larger workers.
    """
    session = broker.sessions.get(request.session)
    if session is not None:
        key = clip_key(session, request)
        broker.outgrown[key] = max(limit_bytes, broker.outgrown.get(key, 0))


def check_parked(broker: Broker, now: float) -> list[Action]:
    """Say which clips no worker can hold, and fail them once all expected workers have been there for a while: a larger
    one may be about to return.
    """
    actions: list[Action] = []
    most, is_complete = broker.registry.most_memory, len(broker.registry.members) >= max(1, broker.expected_workers)
    for clip in list(broker.parked):
        session = broker.sessions.get(clip.requests[0].session)
        clip.trouble = "" if session is None or clip.needs_bytes <= most else _describe(broker, session, clip)
        if not clip.trouble or not is_complete:
            clip.since = now
        elif now - clip.since >= TOO_LARGE_SECONDS:
            broker.parked.remove(clip)
            actions += [action for request in clip.requests for action in fail(broker, request, clip.trouble)]
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
