"""Candidates: which sequence a task is made from, and what moves it on to the next one. No I/O; time is passed in.

A candidate is refused because its video failed, because a worker died of it (a verdict, which is written down first),
or because the quarantine has a verdict already. What was refused travels with the task into the sample's provenance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from v2v_protocol.messages import Unavailable
from v2v_protocol.sample import Refusal
from v2v_protocol.wire import encode
from v2v_server.broker.actions import Instruction, Record, ToConsumer
from v2v_server.broker.counters import Counters
from v2v_server.broker.leases import Task
from v2v_server.broker.quarantine import Quarantine, Verdict
from v2v_server.broker.session import Session, Sessions
from v2v_server.schedule.epoch import MOST_CANDIDATES
from v2v_server.schedule.sequences import Sequence

LONGEST_REASON = 500
"""Characters that a refusal's reason keeps."""


class Candidates:
    """Moves tasks from candidate to candidate.

    Args:
        sessions: the consumers; a task of one that is gone needs nothing more.
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
        self._refusals: list[Refusal] = []

    def take_refusals(self) -> list[Refusal]:
        """The candidates that failed since the last call, for the log."""
        taken, self._refusals = self._refusals, []
        return taken

    def current(self, task: Task, session: Session) -> Task:
        """The task under its session's snapshot.

        Under another snapshot than before others may be passed over: it begins at the first candidate again, as
        whoever makes the sample again does.
        """
        if task.snapshot == session.quarantine:
            return task
        deaths = 0 if task.candidate else task.deaths
        return replace(task, snapshot=session.quarantine, candidate=0, refusals=(), deaths=deaths)

    def sequence(self, session: Session, task: Task) -> Sequence:
        """What the task's candidate is made from."""
        return session.schedule.candidate(session.seed, task.epoch, task.index, task.candidate)

    def quarantined(self, session: Session, task: Task, snapshot: int) -> str | None:
        """Why the task's candidate is refused under a snapshot; None when it is not."""
        sequence = self.sequence(session, task)
        video = sequence.video
        return self._quarantine.refusal(snapshot, video.id, video.fingerprint, sequence.start_frame)

    def condemn(self, task: Task, reason: str) -> list[Instruction]:
        """The task's candidate brought its worker down: a verdict, unless there is one already."""
        session = self._sessions.get(task.session)
        if session is None:
            return []
        if self.quarantined(session, task, self._quarantine.latest) is not None:
            return self.refuse_condemned(task, reason)
        sequence = self.sequence(session, task)
        video, text = sequence.video, reason[:LONGEST_REASON]
        return [Record(Verdict(0, video.id, video.fingerprint, sequence.start_frame, text, self._wall_clock()), task)]

    def refuse_condemned(self, task: Task, reason: str) -> list[Instruction]:
        """On to the next candidate: by the quarantine if the task's snapshot has the verdict, which says the same to
        whoever makes the sample again; else by what happened."""
        session = self._sessions.get(task.session)
        if session is None:
            return []
        if self.quarantined(session, task, session.quarantine) is None:
            return self.refuse(task, None, reason)
        self._sessions.put_back(replace(task, deaths=0))
        return []

    def refuse(self, task: Task, frame: int | None, reason: str, *, log: bool = True) -> list[Instruction]:
        """The task's candidate cannot be used: on to the next, or to the consumer with the whole story."""
        session = self._sessions.get(task.session)
        if session is None:
            return []
        self._counters.refused_candidates += 1
        passed_over = next_candidate(task, self.sequence(session, task).video.id, frame, reason)
        if log:
            self._refusals.append(passed_over.refusals[-1])
        if passed_over.candidate < MOST_CANDIDATES and session.spec.on_bad_video == "substitute":
            self._sessions.put_back(replace(passed_over, deaths=0))
            return []
        if not self._sessions.answered(task, 0.0):
            return []
        self._counters.unavailable += 1
        text = "; ".join(map(str, passed_over.refusals))
        return [ToConsumer(task.session, encode(Unavailable(task.epoch, task.index, text)))]


def next_candidate(task: Task, video: str, frame: int | None, reason: str) -> Task:
    """The task at its next candidate.

    Args:
        task: at the one that is refused.
        video: id of that candidate's video.
        frame, reason: what is wrong with it, see :class:`v2v_protocol.sample.Refusal`.
    """
    refused = Refusal(task.candidate, video, frame, reason[:LONGEST_REASON])
    return replace(task, candidate=task.candidate + 1, refusals=(*task.refusals, refused))
