"""How many workers there should be, within bounds, by what is seen: who waits, and who has nothing to do. Pure.

    waiting share   consumers that have asked for something nobody works on yet, of all consumers
    idle share      workers without any lease, of all workers

Not by the load of processors: a decoder keeps its core busy whether anybody waits or not.

    more     half of the consumers wait, or more, and at most a tenth of the workers are idle: half as many again
    fewer    more than a third of the workers are idle: as many as would be busy four fifths of the time, but no fewer
             than half of those there are

Between the two nothing happens, and that is why it does not swing: those that leave stop at a fifth of idle workers,
far from the tenth at which more come. Each change starts the watch anew, and more are asked for only once those before
came.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

_WAITING = 0.5
_BUSY = 0.1
_IDLE = 0.35
_LEFT_BUSY = 0.8
_GROWTH = 1.5
_PARTS = 6


@dataclass(frozen=True, slots=True)
class Decision:
    """A change.

    Attributes:
        workers: that there shall be.
        reason: in words.
    """

    workers: int
    reason: str


class Scaling:
    """Watches, and decides.

    Args:
        least, most: workers.
        seconds: for how long workers must have been idle until some leave; a sixth of that is enough for more to come.
    """

    def __init__(self, least: int, most: int, seconds: float) -> None:
        self._least, self._most = least, most
        self._part_seconds = seconds / _PARTS
        self._target = least
        self._parts: deque[tuple[float, float]] = deque(maxlen=_PARTS)  # the shares in each part of the time
        self._since: float | None = None
        self._looks = 0
        self._waiting = self._idle = 0.0
        self._lacking = False

    def look(self, now: float, waiting: float, idle: float, present: int) -> Decision | None:
        """What to do. To be called a few times a second.

        Args:
            now: the time, seconds.
            waiting, idle: the shares, 0 to 1.
            present: workers that can work.
        """
        if self._since is None:
            self._since = now
        self._looks += 1
        self._waiting += waiting
        self._idle += idle if present else 0.0  # nobody is idle where nobody is
        self._lacking = self._lacking or present < self._target
        if now - self._since < self._part_seconds:
            return None
        shares, lacking = (self._waiting / self._looks, self._idle / self._looks), self._lacking
        self._parts.append(shares)
        self._begin(now)
        decision = (None if lacking else self._more(*shares)) or self._fewer()
        if decision is not None:
            self._target = decision.workers
            self._parts.clear()
        return decision

    def _begin(self, now: float) -> None:
        """The next part of the time."""
        self._since = now
        self._looks = 0
        self._waiting = self._idle = 0.0
        self._lacking = False

    def _more(self, waiting: float, idle: float) -> Decision | None:
        if self._target >= self._most or waiting < _WAITING or idle > _BUSY:
            return None
        target = min(self._most, max(self._target + 1, math.ceil(self._target * _GROWTH)))
        return Decision(target, _reason(waiting, idle, self._part_seconds))

    def _fewer(self) -> Decision | None:
        # By the busiest part: what was a pause, or its end, sends nobody away who is needed.
        waiting, idle = max(share for share, _ in self._parts), min(share for _, share in self._parts)
        if len(self._parts) < _PARTS or idle <= _IDLE:
            return None
        # A hair less, lest a sum of shares that is a hair too large keeps one worker more.
        needed = math.ceil(self._target * (1.0 - idle) / _LEFT_BUSY - 1e-9)
        needed = max(needed, 1) if idle < 1.0 else 0  # the last one stays while anybody asks for anything
        target = max(self._least, self._target // 2, needed)
        if target >= self._target:
            return None
        return Decision(target, "at the busiest " + _reason(waiting, idle, self._part_seconds))


def _reason(waiting: float, idle: float, seconds: float) -> str:
    return f"{waiting:.0%} of consumers waited and {idle:.0%} of workers were idle in {seconds:.3g} s"
