"""Candidates: which sequence a request is made from, and what moves it on to the next one. No I/O; time is passed in.

A candidate is refused because its video failed, because a worker died of it (a verdict, which is written down first),
or because the quarantine has a verdict already. What was refused travels with the request into the sample's provenance.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace

from v2v_protocol.messages import Unavailable
from v2v_protocol.refusal import Refusal, RefusalKind
from v2v_protocol.wire import encode
from v2v_server.broker.actions import Action, AddToQuarantine, ReportRefusal, ToConsumer
from v2v_server.broker.counters import Counters
from v2v_server.broker.leases import Request
from v2v_server.broker.quarantine import Quarantine, QuarantineEntry
from v2v_server.broker.session import Session, Sessions
from v2v_server.schedule.epoch import MOST_CANDIDATES
from v2v_server.schedule.sequences import VideoSequence

MOST_LATEST = 20
"""Refusals that are remembered for people to read."""
LONGEST_REASON = 500
"""Characters that a refusal's reason keeps."""


class Candidates:
    """Moves requests from candidate to candidate.

    Attributes:
        latest: the last few refusals, oldest first, each with the time of day it fell at, ISO 8601.

    Args:
        sessions: the consumers; a request of one that is gone needs nothing more.
        quarantine: the snapshots.
        counters: of the dispatcher.
        wall_clock: gives the time for a verdict, ISO 8601.
    """

    def __init__(
        self, sessions: Sessions, quarantine: Quarantine, counters: Counters, wall_clock: Callable[[], str]
    ) -> None:
        self._sessions = sessions
        self._quarantine = quarantine
        self._counters = counters
        self._wall_clock = wall_clock
        self.latest: deque[tuple[str, Refusal]] = deque(maxlen=MOST_LATEST)

    def current(self, request: Request, session: Session) -> Request:
        """The request under its session's snapshot.

        Under another snapshot than before others may be passed over: it begins at the first candidate again, as
        whoever makes the sample again does.
        """
        if request.snapshot == session.quarantine:
            return request
        deaths = 0 if request.candidate else request.deaths
        return replace(request, snapshot=session.quarantine, candidate=0, refusals=(), deaths=deaths)

    def sequence(self, session: Session, request: Request) -> VideoSequence:
        """What the request's candidate is made from."""
        return session.schedule.candidate(session.seed, request.epoch, request.index, request.candidate)

    def quarantined(self, session: Session, request: Request, snapshot: int) -> str | None:
        """Why the request's candidate is refused under a snapshot; None when it is not."""
        sequence = self.sequence(session, request)
        video = sequence.video
        return self._quarantine.refusal(
            snapshot, video.id, video.fingerprint, sequence.start_frame, session.spec.digest
        )

    def quarantine_candidate(self, request: Request, reason: str, *, for_all: bool = True) -> list[Action]:
        """The request's candidate brought its worker down: a verdict, unless there is one already.

        Args:
            request: at the candidate.
            reason: what happened.
            for_all: the verdict is against the video; else only under the spec of this request's session.
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
        """On to the next candidate: by the quarantine if the request's snapshot has the verdict, which says the same to
        whoever makes the sample again; else by what happened."""
        session = self._sessions.get(request.session)
        if session is None:
            return []
        if self.quarantined(session, request, session.quarantine) is None:
            return self.refuse(request, None, reason)
        self._sessions.put_back(replace(request, deaths=0))
        return []

    def refuse(
        self, request: Request, frame: int | None, reason: str, kind: RefusalKind = RefusalKind.FAILED
    ) -> list[Action]:
        """The request's candidate cannot be used: on to the next, or to the consumer with the whole story."""
        session = self._sessions.get(request.session)
        if session is None:
            return []
        self._counters.refused_candidates += 1
        refusal = Refusal(self.sequence(session, request).video.id, frame, reason, kind)
        passed_over = next_candidate(request, refusal)
        self.latest.append((self._wall_clock(), passed_over.refusals[-1]))
        # What the quarantine refuses is no news to the operator.
        actions: list[Action] = (
            [ReportRefusal(passed_over.refusals[-1], request)] if kind != RefusalKind.QUARANTINED else []
        )
        if passed_over.candidate < MOST_CANDIDATES and session.spec.on_bad_video == "substitute":
            self._sessions.put_back(replace(passed_over, deaths=0))
            return actions
        if not self._sessions.mark_answered(request, 0.0):
            return actions
        self._counters.unavailable += 1
        text = "; ".join(dict.fromkeys(map(str, passed_over.refusals)))
        return [*actions, ToConsumer(request.session, encode(Unavailable(request.epoch, request.index, text)))]


def next_candidate(request: Request, refusal: Refusal) -> Request:
    """The request at its next candidate.

    Args:
        request: at the one that is refused.
        refusal: of that candidate's video.
    """
    refusal = replace(refusal, reason=refusal.reason[:LONGEST_REASON])
    return replace(request, candidate=request.candidate + 1, refusals=(*request.refusals, refusal))
