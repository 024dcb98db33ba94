"""What went on over the last seconds: running totals, noted once a second, from which rates and shares follow. Pure."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

from v2v_server.broker.dispatcher import Dispatcher

WINDOW_SECONDS = 10.0
NOTE_SECONDS = 1.0
_AWAY_SECONDS = 2.0


@dataclass(frozen=True, slots=True)
class Moment:
    """The totals at one time, seconds by the clock unless said otherwise.

    Attributes:
        now: the time.
        samples, batches, array_bytes, decodes: handed over; see :class:`v2v_server.broker.counters.Counters`.
        decode_seconds, simulate_seconds, handover_seconds: of all workers together.
        queued_seconds: of the server's own workers, in which they waited for a core.
        cpu_seconds: processor time of all workers together.
        attended_seconds: in which there was a consumer; only in these the next three are counted: that nobody has work
            while nobody wants any says nothing.
        broker_seconds: that the server's loop did not wait for a message.
        worker_seconds: that there were workers, times how many.
        idle_seconds: of these, in which they held no lease.
        consumer_seconds: that there were consumers, times how many.
        waited_seconds: of these, in which they waited for samples.
        cpu: processor time, by worker.
        busy: time by the clock that samples took, by worker.
        waited: time that a consumer waited for samples, by consumer.
        served: samples, by consumer.
        positions: (epoch, position in it), by consumer.
    """

    now: float
    samples: int = 0
    batches: float = 0.0
    array_bytes: int = 0
    decodes: int = 0
    decode_seconds: float = 0.0
    simulate_seconds: float = 0.0
    handover_seconds: float = 0.0
    queued_seconds: float = 0.0
    cpu_seconds: float = 0.0
    attended_seconds: float = 0.0
    broker_seconds: float = 0.0
    worker_seconds: float = 0.0
    idle_seconds: float = 0.0
    consumer_seconds: float = 0.0
    waited_seconds: float = 0.0
    cpu: Mapping[bytes, float] = field(default_factory=dict)
    busy: Mapping[bytes, float] = field(default_factory=dict)
    waited: Mapping[bytes, float] = field(default_factory=dict)
    served: Mapping[bytes, int] = field(default_factory=dict)
    positions: Mapping[bytes, tuple[int, int]] = field(default_factory=dict)


class History:
    """The last ten seconds.

    Args:
        now: the time.
    """

    def __init__(self, now: float) -> None:
        self._moments: deque[Moment] = deque()
        self._looked = now
        self._note_at = now
        self._attended_seconds = self._broker_seconds = 0.0
        self._worker_seconds = self._idle_seconds = self._consumer_seconds = 0.0
        self._broker_before = 0.0
        self._attended_at = -math.inf

    def look(self, now: float, dispatcher: Dispatcher, broker_seconds: float) -> None:
        """To be called a few times a second.

        Args:
            now: the time.
            dispatcher: whose totals are noted.
            broker_seconds: since the start, in which the loop did not wait for a message.
        """
        since, self._looked = max(0.0, now - self._looked), now
        busy, self._broker_before = broker_seconds - self._broker_before, broker_seconds
        if consumers := dispatcher.consumers:
            self._attended_at = now
            self._attended_seconds += since
            self._broker_seconds += busy
            self._worker_seconds += since * dispatcher.workers
            self._idle_seconds += since * dispatcher.workers * dispatcher.idle_share
            self._consumer_seconds += since * consumers
        if now < self._note_at:
            return
        self._note_at = now + NOTE_SECONDS
        self._moments.append(self._moment(now, dispatcher))
        while len(self._moments) > 2 and now - self._moments[1].now >= WINDOW_SECONDS:
            self._moments.popleft()

    def is_attended(self, now: float) -> bool:
        """Whether there is a consumer, or was a moment ago: from one epoch to the next they leave and come again."""
        return now - self._attended_at < _AWAY_SECONDS

    def window(self, now: float, dispatcher: Dispatcher) -> tuple[Moment, Moment]:
        """The totals some ten seconds ago, or at the start, and those of now. For the arguments see :meth:`look`."""
        last = self._moment(now, dispatcher)
        return (self._moments[0] if self._moments else last), last

    def _moment(self, now: float, dispatcher: Dispatcher) -> Moment:
        counters, members = dispatcher.counters, dispatcher.registry.members()
        work = counters.work
        return Moment(
            now,
            counters.samples,
            counters.batches,
            counters.bytes,
            counters.decodes,
            work.decode_seconds,
            work.simulate_seconds,
            work.handover_seconds,
            counters.queued_seconds,
            work.cpu_seconds,
            self._attended_seconds,
            self._broker_seconds,
            self._worker_seconds,
            self._idle_seconds,
            self._consumer_seconds,
            counters.waited_seconds,
            {identity: member.work.cpu_seconds for identity, member in members.items()},
            {identity: member.work.busy_seconds for identity, member in members.items()},
            {session.identity: session.waited_seconds for session in dispatcher.sessions},
            {session.identity: session.served for session in dispatcher.sessions},
            {session.identity: (session.epoch, session.position) for session in dispatcher.sessions},
        )
