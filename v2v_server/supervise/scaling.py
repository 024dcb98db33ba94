"""Choose the number of workers within bounds, from waiting consumers and idle workers. Pure.

    waiting share   consumers that have requests without a worker, of all consumers
    idle share      workers without any lease, of all workers

The load of the processors says nothing: a decoder keeps its core busy whether a consumer waits or not.

    more     at least half of the consumers wait, and at most a tenth of the workers are idle: half as many again
    fewer    more than a third of the workers are idle: as many as would be busy four fifths of the time, but at least
             half of the present number

Between the two the number stays, so it does not oscillate: after a reduction a fifth of the workers are idle, well
above the tenth that allows an increase. Each change restarts the measurement, and more workers are requested only once
those requested before are present.
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
_MANY_WORKERS_A_CORE = 4


@dataclass(frozen=True, slots=True)
class Decision:
    """A change.

    Attributes:
        workers: the new number.
        reason: why, in words.
    """

    workers: int
    reason: str


class Scaling:
    """Measure the shares, and decide.

    Args:
        least, most: bounds of the number of workers.
        seconds: time that workers must have been idle before some leave; a sixth of it is enough for an increase.
    """

    def __init__(self, least: int, most: int, seconds: float) -> None:
        self._least, self._most = least, most
        self._part_seconds = seconds / _PARTS
        self._target = least
        self._parts: deque[tuple[float, float]] = deque(maxlen=_PARTS)  # shares in each sixth of the time
        self._since: float | None = None
        self._calls = 0
        self._waiting = self._idle = 0.0
        self._lacking = False

    def decide(self, now: float, waiting: float, idle: float, present: int) -> Decision | None:
        """Return the change to make, if there is one. Call it a few times a second.

        Args:
            now: monotonic time, seconds.
            waiting, idle: the shares, 0 to 1.
            present: number of workers that are connected.
        """
        if self._since is None:
            self._since = now
        self._calls += 1
        self._waiting += waiting
        self._idle += idle if present else 0.0
        self._lacking = self._lacking or present < self._target
        if now - self._since < self._part_seconds:
            return None
        shares, lacking = (self._waiting / self._calls, self._idle / self._calls), self._lacking
        self._parts.append(shares)
        self._begin(now)
        decision = (None if lacking else self._more(*shares)) or self._fewer()
        if decision is not None:
            self._target = decision.workers
            self._parts.clear()
        return decision

    def _begin(self, now: float) -> None:
        """Begin the next sixth of the time."""
        self._since = now
        self._calls = 0
        self._waiting = self._idle = 0.0
        self._lacking = False

    def _more(self, waiting: float, idle: float) -> Decision | None:
        if self._target >= self._most or waiting < _WAITING or idle > _BUSY:
            return None
        target = min(self._most, max(self._target + 1, math.ceil(self._target * _GROWTH)))
        return Decision(target, _reason(waiting, idle, self._part_seconds))

    def _fewer(self) -> Decision | None:
        # The busiest part counts: a pause, or its end, must not stop workers that are needed.
        waiting, idle = max(share for share, _ in self._parts), min(share for _, share in self._parts)
        if len(self._parts) < _PARTS or idle <= _IDLE:
            return None
        # Slightly less: a rounding error in the sum of shares must not keep one worker more.
        needed = math.ceil(self._target * (1.0 - idle) / _LEFT_BUSY - 1e-9)
        needed = max(needed, 1) if idle < 1.0 else 0  # the last one stays while there are requests
        target = max(self._least, self._target // 2, needed)
        if target >= self._target:
            return None
        return Decision(target, "at the busiest " + _reason(waiting, idle, self._part_seconds))


def _reason(waiting: float, idle: float, seconds: float) -> str:
    return f"{waiting:.0%} of consumers waited and {idle:.0%} of workers were idle in {seconds:.3g} s"


def question_workers(workers: int, cores: int) -> str:
    """Return a warning if there are more workers than cores; empty otherwise."""
    if workers <= _MANY_WORKERS_A_CORE * cores:
        return ""
    return (
        f"warning: --workers {workers} on {cores} cores: each uses one core, and more than {cores} only "
        f"cost memory; --workers {cores} makes as many samples"
    )
