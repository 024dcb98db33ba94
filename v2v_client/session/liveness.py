"""Define how long a consumer waits for its server. Only time spent listening counts. Pure.

Time in which the trainer validates, or in which its process is stopped, does not count as silence of the server.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

from v2v_protocol.errors import NoWorkers, UsageError

_STOPPED_SECONDS = 1.0
"""If a wait exceeds its deadline by this much, the process was stopped."""
_WARN_SECONDS = 5.0
"""A server without workers is logged after this time."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Patience:
    """Hold a consumer's timeouts.

    Attributes:
        ping_seconds: silence after which the server is pinged, and the interval of further pings. It is at most half of
            ``timeout_seconds``, so that the server is always pinged before it counts as lost.
        rewant_seconds: time without an answer to any request after which all are sent again, although the server is
            alive: a network interruption can lose messages in either direction. If nothing was received in that time,
            a new connection is opened. The interval doubles each time, up to ``timeout_seconds``, so that a slow
            network is neither flooded nor abandoned before it can answer.
        timeout_seconds: silence after which the server counts as lost, and time without a sample after which a server
            without workers does.
        takeover_seconds: with several brokers, silence after which the next one is tried. ServerLost is raised after
            ``timeout_seconds``, once each of them has had its turn.

    Raises:
        UsageError: a time is not positive.
    """

    timeout_seconds: float = 60.0
    ping_seconds: float = 2.0
    rewant_seconds: float = 10.0
    takeover_seconds: float = 10.0

    def __post_init__(self) -> None:
        for name in ("timeout_seconds", "ping_seconds", "rewant_seconds", "takeover_seconds"):
            if not getattr(self, name) > 0:
                raise UsageError(f"{name} = {getattr(self, name)!r}: give a positive number of seconds")


class ListeningClock:
    """Measure the seconds spent listening. ``now`` is the caller's monotonic clock, in seconds."""

    def __init__(self, now: float) -> None:
        self._away = 0.0
        self._paused = now

    def time(self, now: float) -> float:
        """Return the seconds of listening so far, from an arbitrary origin."""
        return now - self._away

    def listen(self, now: float) -> None:
        """Start listening. The time since :meth:`pause` does not count."""
        self._away += max(0.0, now - self._paused)

    def pause(self, now: float) -> None:
        """Stop listening."""
        self._paused = now

    def wake(self, now: float, due: float) -> None:
        """End a wait for messages that was to end at ``due`` at the latest.

        If ``due`` is over 1 s ago, this process was stopped (in a terminal, by a batch system) and could not receive;
        the excess does not count.
        """
        if now - due > _STOPPED_SECONDS:
            self._away += now - due


class WorkerShortage:
    """Measure how long a server that answers has had no worker to make a requested sample.

    Args:
        now: seconds of listening.
        limit_seconds: time after which the consumer gives up.
    """

    def __init__(self, now: float, limit_seconds: float) -> None:
        self._since = now
        self._limit_seconds = limit_seconds
        self._warned = False

    def end(self, now: float) -> None:
        """Record that the server answered a request, or was replaced."""
        self._since = now

    def check(self, address: str, trouble: str, now: float) -> None:
        """Record the trouble that a server reports with its workers; log it after 5 s.

        Args:
            address: of the server.
            trouble: why no sample can be made; empty if there is no trouble, or no request.

        Raises:
            NoWorkers: there has been trouble for ``limit_seconds``.
        """
        if not trouble:
            self._since, self._warned = now, False
            return
        waited = now - self._since
        text = f"{address}: no sample for {waited:.0f} s, because {trouble}"
        if waited >= self._limit_seconds:
            raise NoWorkers(f"{text}; or wait longer with timeout_seconds (now {self._limit_seconds:g})")
        if waited >= _WARN_SECONDS and not self._warned:
            self._warned = True
            _log.warning("%s; giving up after %g s (timeout_seconds)", text, self._limit_seconds)
