"""Track whether a peer is alive: when it was last heard, when to ping it, when it is gone. Pure; times are seconds on
the caller's monotonic clock.
"""

from __future__ import annotations

import math


class Liveness:
    """State of one peer.

    Args:
        now: monotonic time, seconds; the peer counts as heard now.
        gone_seconds: silence after which the peer is gone; infinite: never.
        ping_seconds: silence after which the peer is pinged; infinite: never.
        longest_ping_seconds: the interval between pings doubles each time, up to this; by default it stays
            ``ping_seconds``.
    """

    __slots__ = ("_ask_at", "_gone_seconds", "_heard", "_longest_wait", "_ping_seconds", "_wait")

    def __init__(
        self,
        now: float,
        *,
        gone_seconds: float = math.inf,
        ping_seconds: float = math.inf,
        longest_ping_seconds: float = 0.0,
    ) -> None:
        self._gone_seconds = gone_seconds
        self._ping_seconds = ping_seconds
        self._longest_wait = max(ping_seconds, longest_ping_seconds)
        self.mark_heard(now)

    def mark_heard(self, now: float) -> None:
        """Note a message from the peer."""
        self._heard = now
        self._wait = self._ping_seconds
        self._ask_at = now + self._wait

    @property
    def heard_at(self) -> float:
        """When the peer was last heard."""
        return self._heard

    def silence(self, now: float) -> float:
        """Return the seconds since the peer was heard."""
        return now - self._heard

    def is_gone(self, now: float) -> bool:
        """Return whether it has been silent for too long."""
        return self.silence(now) >= self._gone_seconds

    def ping_due(self, now: float) -> bool:
        """Return whether to ping the peer now. After True the caller must send the ping."""
        if now < self._ask_at:
            return False
        self._wait = min(2 * self._wait, self._longest_wait)
        self._ask_at = now + self._wait
        return True

    def next_due(self, now: float) -> float:
        """Return the seconds until :meth:`ping_due` or :meth:`is_gone` changes, at least 0."""
        return max(0.0, min(self._ask_at, self._heard + self._gone_seconds) - now)
