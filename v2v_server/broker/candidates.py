"""Refuse a candidate: the sequence that a request is made from at the moment. The next ones stand in for it.

A candidate is refused because its video failed, because it brought a worker down (written to the quarantine first), or
because it already is in quarantine. The refusals travel with the request into the sample's provenance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from v2v_protocol.messages import Unavailable, encode
from v2v_protocol.sample import Refusal, RefusalKind
from v2v_server.broker.leases import Request
from v2v_server.broker.session import Session
from v2v_server.broker.state import Action, AddToQuarantine, Broker, CheckVideo, RefusalPart, ReportRefusal, ToConsumer
from v2v_server.quarantine import QuarantineEntry
from v2v_server.schedule import MOST_CANDIDATES

LONGEST_REASON = 500
"""Characters kept of a refusal's reason."""


def quarantine_reason(broker: Broker, session: Session, request: Request, snapshot: int) -> str | None:
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
    if quarantine_reason(broker, session, request, broker.quarantine.latest) is not None:
        return refusequarantine_reason(broker, request, reason)
    sequence = session.sequence(request)
    entry = QuarantineEntry(
        snapshot=0,
        path=sequence.video.id,
        fingerprint=sequence.video.fingerprint,
        frame=sequence.start_frame,
        reason=reason[:LONGEST_REASON],
        time=broker.wall_clock(),
        spec="" if for_all else session.spec.digest,
    )
    return [AddToQuarantine(entry, request)]


def extend_quarantine(broker: Broker, record: AddToQuarantine, written: Sequence[QuarantineEntry]) -> list[Action]:
    """Continue after an :class:`AddToQuarantine`.

    Args:
        record: the action.
        written: the lines that the quarantine has gained, including those of other processes; empty if it cannot be
            written.
    """
    before = broker.quarantine.latest
    broker.quarantine.extend(written)
    # Consumers under the newest snapshot move on to the new one. A consumer that resumed an older snapshot keeps it:
    # entries cleared since must not return, and sequences that it refused must stay refused.
    for each in broker.sessions:
        if each.quarantine == before:
            each.quarantine = broker.quarantine.latest
    return refusequarantine_reason(broker, record.request, record.entry.reason)


def refusequarantine_reason(broker: Broker, request: Request, reason: str) -> list[Action]:
    """Move the request to its next candidate. If the session's snapshot holds the entry, the refusal comes from the
    quarantine, which a later remake finds as well; otherwise it states what happened.
    """
    session = broker.sessions.get(request.session)
    if session is None:
        return []
    if quarantine_reason(broker, session, request, session.quarantine) is None:
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
