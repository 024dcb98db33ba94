"""Totals of the last seconds, noted once a second: rates and shares are their differences. Pure."""

from __future__ import annotations

import math
from collections import defaultdict, deque
from collections.abc import Mapping
from dataclasses import dataclass

from v2v_server.broker.dispatcher import Dispatcher
from v2v_server.broker.session import AWAY_SECONDS
from v2v_server.system.status_fields import values

WINDOW_SECONDS = 10.0
NOTE_SECONDS = 1.0
_LEAST_SECONDS = 1.0
"""Shortest time that the rates of a new consumer are measured over."""


@dataclass(frozen=True, slots=True)
class Moment:
    """The totals at one time.

    Attributes:
        now: monotonic time, seconds.
        totals: the counters; and, of the time in which there was a consumer, ``attended``, ``broker`` (the loop did not
            wait for a message), ``worker`` and ``consumer`` (times their number), ``idle`` (of ``worker``, without a
            lease), in seconds.
        peers: totals of each peer, the first of them a clock: ``now`` for a worker, the seconds that it was there for a
            consumer. Then busy and processor seconds of a worker, by routing id, or samples, seconds waited and indices
            passed of a consumer, by number.
    """

    now: float
    totals: Mapping[str, float]
    peers: Mapping[bytes | int, tuple[float, ...]]


@dataclass(frozen=True, slots=True)
class TimeWindow:
    """The time between two moments."""

    before: Moment
    last: Moment

    @property
    def seconds(self) -> float:
        """Return the length of the window, seconds."""
        return self.last.now - self.before.now

    def change(self, name: str) -> float:
        """Return by how much a total grew."""
        return self.last.totals.get(name, 0.0) - self.before.totals.get(name, 0.0)

    def rate(self, name: str) -> float:
        """Return the same per second; 0 for an empty window."""
        return self.change(name) / self.seconds if self.seconds > 0.0 else 0.0

    def share(self, part: str, whole: str) -> float:
        """Return the growth of one total as a share of another's, 0 to 1."""
        return min(1.0, max(0.0, self.change(part) / self.change(whole))) if self.change(whole) > 0.0 else 0.0

    def rates_of(self, peer: bytes | int) -> list[float]:
        """Return the rates of a peer's totals: a worker's over the window, a consumer's over its time in the window."""
        present, *totals = self.last.peers[peer]
        before_present, *before = self.before.peers.get(peer, (0.0,) * (1 + len(totals)))
        seconds = min(self.seconds, max(_LEAST_SECONDS, present - before_present))
        return [(now - then) / seconds if seconds > 0.0 else 0.0 for now, then in zip(totals, before, strict=True)]


class History:
    """The last ten seconds of a dispatcher.

    Args:
        dispatcher: whose totals are noted.
        now: monotonic time, seconds.
    """

    def __init__(self, dispatcher: Dispatcher, now: float) -> None:
        self._dispatcher = dispatcher
        self._moments: deque[Moment] = deque()
        self._noted = self._note_at = now
        self._clocks: defaultdict[str, float] = defaultdict(float)
        self._broker_seconds = 0.0
        self._attended_at = -math.inf

    def note(self, now: float, broker_seconds: float) -> None:
        """Note the time that passed. Call a few times a second.

        Args:
            now: monotonic time, seconds.
            broker_seconds: time since the start in which the loop did not wait for a message.
        """
        passed, self._noted = max(0.0, now - self._noted), now
        busy, self._broker_seconds = broker_seconds - self._broker_seconds, broker_seconds
        if consumers := self._dispatcher.consumers:
            # Idle workers matter only while there is a consumer.
            self._attended_at = now
            worker = passed * self._dispatcher.workers
            idle = worker * self._dispatcher.idle_share
            clocks = {
                "attended": passed,
                "broker": busy,
                "worker": worker,
                "idle": idle,
                "consumer": passed * consumers,
            }
            for name, seconds in clocks.items():
                self._clocks[name] += seconds
        if now >= self._note_at:
            self._note_at = now + NOTE_SECONDS
            self._moments.append(self._moment(now))
            while len(self._moments) > 2 and now - self._moments[1].now >= WINDOW_SECONDS:
                self._moments.popleft()

    def is_attended(self, now: float) -> bool:
        """Return whether there is a consumer, or was a moment ago: between epochs they leave and return."""
        return now - self._attended_at < AWAY_SECONDS or self._dispatcher.consumers > 0

    def window(self, now: float) -> TimeWindow:
        """Return the last ten seconds, or the time since the start."""
        last = self._moment(now)
        return TimeWindow(self._moments[0] if self._moments else last, last)

    def _moment(self, now: float) -> Moment:
        peers: dict[bytes | int, tuple[float, ...]] = {
            identity: (now, member.work.busy_seconds, member.work.cpu_seconds)
            for identity, member in self._dispatcher.registry.members().items()
        }
        for each in self._dispatcher.sessions.totals():
            peers[each.number] = each.present(now), each.served, each.waited_seconds, each.passed
        return Moment(now, values(self._dispatcher.counters) | self._clocks, peers)
