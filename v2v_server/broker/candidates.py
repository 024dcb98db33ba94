"""Choose which sequence a request is made from, and move it to the next one. No I/O; time is passed in.

A candidate is refused because its video failed, because it brought a worker down (written to the quarantine first), or
because it already is in quarantine. The refusals travel with the request into the sample's provenance.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

from v2v_protocol.messages import Unavailable, encode
from v2v_protocol.sample import Refusal, RefusalKind
from v2v_server.broker.actions import Action, AddToQuarantine, CheckVideo, ReportRefusal, ToConsumer
from v2v_server.broker.counters import Counters
from v2v_server.broker.leases import Request
from v2v_server.broker.session import Session, Sessions
from v2v_server.quarantine.snapshots import Quarantine, QuarantineEntry
from v2v_server.schedule.epoch import MOST_CANDIDATES
from v2v_server.schedule.sequences import VideoSequence
from v2v_server.system.status_fields import short, text

MOST_LATEST = 20
"""Number of refusals kept for the status."""
LONGEST_REASON = 500
"""Characters kept of a refusal's reason."""


@dataclass(frozen=True, slots=True)
class RefusalPart:
    """One of the last skipped candidates, newest first."""

    time: str = text("Time, ISO 8601, UTC.")
    video: str = text("Catalogue id of the video.")
    frame: int | None = text("First frame; null if it is the whole video.")
    reason: str = text("Why it was skipped.")
    kind: str = text("Kind of refusal: failed, quarantined and others.")


class Candidates:
    """Move requests from candidate to candidate.

    Attributes:
        latest: the last few refusals, oldest first, each with its time of day, ISO 8601.

    Args:
        sessions: the consumers; a request of a consumer that is gone is dropped.
        quarantine: the snapshots.
        counters: the dispatcher's totals.
        wall_clock: returns the time for a quarantine entry, ISO 8601.
    """

    def __init__(
        self, sessions: Sessions, quarantine: Quarantine, counters: Counters, wall_clock: Callable[[], str]
    ) -> None:
        self._sessions = sessions
        self._quarantine = quarantine
        self._counters = counters
        self._wall_clock = wall_clock
        self.latest: deque[tuple[str, Refusal]] = deque(maxlen=MOST_LATEST)

    def parts(self) -> list[RefusalPart]:
        """Return the last few refusals, newest first, for the status."""
        return [
            RefusalPart(when, short(each.video), each.frame, short(each.reason), str(each.kind))
            for when, each in reversed(self.latest)
        ]

    def current(self, request: Request, session: Session) -> Request:
        """Return the request under its session's snapshot.

        Another snapshot may refuse other candidates. So the request starts again at the first candidate, as a later
        remake of the sample does.
        """
        if request.snapshot == session.quarantine:
            return request
        deaths = 0 if request.candidate else request.deaths
        return replace(request, snapshot=session.quarantine, candidate=0, refusals=(), deaths=deaths)

    def sequence(self, session: Session, request: Request) -> VideoSequence:
        """Return the sequence of the request's candidate."""
        return session.schedule.candidate(session.seed, request.epoch, request.index, request.candidate)

    def quarantined(self, session: Session, request: Request, snapshot: int) -> str | None:
        """Return why the request's candidate is refused under a snapshot; None if it is not."""
        sequence = self.sequence(session, request)
        video = sequence.video
        return self._quarantine.refusal(
            snapshot, video.id, video.fingerprint, sequence.start_frame, session.spec.digest
        )

    def quarantine_candidate(self, request: Request, reason: str, *, for_all: bool = True) -> list[Action]:
        """Quarantine the request's candidate, which brought its worker down, unless it is in quarantine already.

        Args:
            request: the request at that candidate.
            reason: what happened.
            for_all: whether the entry holds for every spec; otherwise only for the spec of this request's session.
        """
        session = self._sessions.get(request.session)
        if session is None:
            return []
        if self.quarantined(session, request, self._quarantine.latest) is not None:
            return self.refuse_quarantined(request, reason)
        sequence = self.sequence(session, request)
        video, text = sequence.video, reason[:LONGEST_REASON]
        spec, time = "" if for_all else session.spec.digest, self._wall_clock()
        return [
            AddToQuarantine(
                QuarantineEntry(0, video.id, video.fingerprint, sequence.start_frame, text, time, spec), request
            )
        ]

    def refuse_quarantined(self, request: Request, reason: str) -> list[Action]:
        """Move the request to its next candidate. If the session's snapshot holds the entry, the refusal comes from the
        quarantine, which a later remake finds as well; otherwise it states what happened.
        """
        session = self._sessions.get(request.session)
        if session is None:
            return []
        if self.quarantined(session, request, session.quarantine) is None:
            return self.refuse(request, None, reason)
        self._sessions.put_back(replace(request, deaths=0))
        return []

    def refuse(self, request: Request, frame: int | None, reason: str, kind: str = RefusalKind.FAILED) -> list[Action]:
        """Move the request to its next candidate, or tell the consumer that the sample is unavailable and list all
        refusals.
        """
        session = self._sessions.get(request.session)
        if session is None:
            return []
        self._counters.refused_candidates += 1
        refusal = Refusal(self.sequence(session, request).video.id, frame, reason, kind)
        passed_over = next_candidate(request, refusal)
        self.latest.append((self._wall_clock(), passed_over.refusals[-1]))
        # The operator was told when the candidate was quarantined.
        actions: list[Action] = (
            [ReportRefusal(passed_over.refusals[-1], request)] if kind != RefusalKind.QUARANTINED else []
        )
        if passed_over.candidate < MOST_CANDIDATES and session.spec.on_bad_video == "substitute":
            self._sessions.put_back(replace(passed_over, deaths=0))
            return actions
        return [*actions, *self.fail(request, "; ".join(dict.fromkeys(map(str, passed_over.refusals))))]

    def blame(self, failure: CheckVideo) -> list[Action]:
        """Refuse a video. A sidecar never changes which video is shown: its consumer gets an error instead."""
        if failure.sidecar:
            return self.fail(failure.request, f"{failure.video}: its sidecar {failure.sidecar}: {failure.reason}")
        return self.refuse(failure.request, failure.frame, failure.reason)

    def fail(self, request: Request, text: str) -> list[Action]:
        """Tell the consumer that a sample is unavailable, without blaming its video."""
        if not self._sessions.mark_answered(request, 0.0):
            return []
        self._counters.unavailable += 1
        return [ToConsumer(request.session, encode(Unavailable(request.epoch, request.index, text)))]


def next_candidate(request: Request, refusal: Refusal) -> Request:
    """Return the request at its next candidate.

    Args:
        request: the request at the refused candidate.
        refusal: of that candidate's video.
    """
    refusal = replace(refusal, reason=refusal.reason[:LONGEST_REASON])
    return replace(request, candidate=request.candidate + 1, refusals=(*request.refusals, refusal))
