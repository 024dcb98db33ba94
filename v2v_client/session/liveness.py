"""When a silent server is asked whether it lives, asked again for what may be lost, and given up. Pure.

Only time spent listening counts: a trainer that validates for ten minutes has not been kept waiting by the server.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from v2v_protocol.errors import UsageError

_STOPPED_SECONDS = 1.0
"""A wait that takes so much longer than was asked for: this process did not run."""


class Due(Enum):
    """What the silence calls for."""

    PING = "ping"
    WANT_AGAIN = "want again"
    CONNECT_ANEW = "connect anew"
    GIVE_UP = "give up"


@dataclass(frozen=True, slots=True)
class Patience:
    """
    Attributes:
        ping_seconds: silence after which the server is asked whether it lives, and again as often; half of
            ``timeout_seconds`` if that is less, because nobody is given up unasked.
        rewant_seconds: time without an answer to any request after which all of them are sent again, although the
            server lives: a cut of the network can swallow messages in either direction. If nothing at all was heard
            in that time, another connection is made. The wait doubles each time, up to ``timeout_seconds``, so that a
            network which is only slow is not flooded, nor left before it could answer.
        timeout_seconds: silence after which the server is given up.

    Raises:
        UsageError: a time that is not positive.
    """

    timeout_seconds: float = 60.0
    ping_seconds: float = 2.0
    rewant_seconds: float = 10.0

    def __post_init__(self) -> None:
        for name in ("timeout_seconds", "ping_seconds", "rewant_seconds"):
            if not getattr(self, name) > 0:
                raise UsageError(f"{name} = {getattr(self, name)!r}: give a positive number of seconds")


class Liveness:
    """What one connection heard, and when. ``now`` is seconds on the caller's clock, which never goes back."""

    def __init__(self, patience: Patience, now: float) -> None:
        self._patience = patience
        self._ping_seconds = min(patience.ping_seconds, patience.timeout_seconds / 2)
        self._rewant_seconds = min(patience.rewant_seconds, patience.timeout_seconds)
        self._heard = now
        self._answered = now
        self._pinged = now
        self._listened_until = now

    def listen(self, now: float) -> None:
        """The caller begins to listen; the time since :meth:`pause` does not count."""
        self._leave_out(max(0.0, now - self._listened_until))

    def woke(self, now: float, due: float) -> None:
        """The caller waited for post, until ``due`` at the latest. If that is long ago, this process was stopped (in a
        terminal, by a batch system), and the server could not be heard."""
        if now - due > _STOPPED_SECONDS:
            self._leave_out(now - due)

    def _leave_out(self, seconds: float) -> None:
        self._heard += seconds
        self._answered += seconds
        self._pinged += seconds

    def pause(self, now: float) -> None:
        """The caller stops listening."""
        self._listened_until = now

    def heard(self, now: float, *, answer: bool) -> None:
        """Something came; ``answer`` when it answers a request, so that nothing needs to be asked again yet."""
        self._heard = self._pinged = now
        if answer:
            self._answered = now

    def silence(self, now: float) -> float:
        """Seconds for which nothing was heard while listening."""
        return now - self._heard

    def due(self, now: float) -> Due | None:
        """What to do now; asking for it counts as doing it."""
        if now - self._heard >= self._patience.timeout_seconds:
            return Due.GIVE_UP
        if now - self._answered >= self._rewant_seconds:
            silent = now - self._heard >= self._rewant_seconds
            self._answered = self._pinged = now
            self._rewant_seconds = min(2 * self._rewant_seconds, self._patience.timeout_seconds)
            return Due.CONNECT_ANEW if silent else Due.WANT_AGAIN
        if now - self._pinged >= self._ping_seconds:
            self._pinged = now
            return Due.PING
        return None

    def next_due(self, now: float) -> float:
        """Seconds until :meth:`due` has something to do, at least 0."""
        return max(
            0.0,
            min(
                self._heard + self._patience.timeout_seconds,
                self._answered + self._rewant_seconds,
                self._pinged + self._ping_seconds,
            )
            - now,
        )
