"""How long a consumer waits, and in which time: only time spent listening counts. Pure.

A trainer that validates for ten minutes has not been kept waiting by the server, nor has one that was stopped.
"""

from __future__ import annotations

from dataclasses import dataclass

from v2v_protocol.errors import UsageError

_STOPPED_SECONDS = 1.0
"""A wait that takes so much longer than was asked for: this process did not run."""


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
        timeout_seconds: silence after which the server is given up, and time without a sample after which one is that
            has no worker to make it.
        takeover_seconds: with several brokers, silence after which the next one is turned to. ServerLost is raised
            after ``timeout_seconds``, once every one of them has had as long.

    Raises:
        UsageError: a time that is not positive.
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
    """Seconds of listening, from those of the caller's clock (``now``), which never goes back."""

    def __init__(self, now: float) -> None:
        self._away = 0.0
        self._paused = now

    def time(self, now: float) -> float:
        """Seconds of listening so far, from an arbitrary beginning."""
        return now - self._away

    def listen(self, now: float) -> None:
        """The caller begins to listen; the time since :meth:`pause` does not count."""
        self._away += max(0.0, now - self._paused)

    def pause(self, now: float) -> None:
        """The caller stops listening."""
        self._paused = now

    def wake(self, now: float, due: float) -> None:
        """The caller waited for post, until ``due`` at the latest. If that is long ago, this process was stopped (in a
        terminal, by a batch system), and the server could not be heard."""
        if now - due > _STOPPED_SECONDS:
            self._away += now - due
