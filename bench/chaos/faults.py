"""The faults of the chaos bench: their kinds, how often each occurs, and the processes that they hit.

    worker-kill, -term, -segv     one of the server's workers ends by that signal, or one of the pool
    worker-hang                   one is stopped for good: the server's watchdog must end it; a pool has none
    worker-pause                  one is stopped and continues a little later
    further-add                   one more worker joins by `v2v-worker --connect`
    further-kill, -term           a further worker ends
    further-pause                 one is stopped, perhaps until its leases are reassigned, then continues
    server-kill                   SIGKILL; the server restarts on the same address
    consumer-kill                 SIGKILL; the consumer resumes from its last saved state
    consumer-pause                one is stopped for a few seconds; it must not hold up the others
    peers-hello, -headers, ...    eight hostile peers for some seconds, see :mod:`bench.chaos.hostile`
    cache-delete                  with a cache: its folder is deleted
    cache-flip, -cut              one bit of a cached file is flipped, or its end is cut off

A SIGSEGV is blamed on the sequence in work, by design, and two of them quarantine its video. They are fewer than the
videos, because a long clip may be a video's only sequence.
"""

from __future__ import annotations

import contextlib
import math
import os
import random
import shutil
import signal
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

from bench.chaos.fleet import Fleet, Process
from bench.chaos.hostile import KINDS

WEIGHTS = {
    "worker-kill": 5.0,
    "worker-term": 4.0,
    "worker-segv": 3.0,
    "worker-hang": 1.5,
    "worker-pause": 1.5,
    "further-add": 3.0,
    "further-kill": 2.0,
    "further-term": 2.0,
    "further-pause": 0.5,
    "server-kill": 1.5,
    "consumer-kill": 5.0,
    "consumer-pause": 1.0,
    **{f"peers-{kind}": 0.5 for kind in KINDS},
    "cache-delete": 0.5,
    "cache-flip": 2.0,
    "cache-cut": 2.0,
}
"""Relative frequency of each kind."""
_SIGNALS = {"kill": signal.SIGKILL, "term": signal.SIGTERM, "segv": signal.SIGSEGV, "hang": signal.SIGSTOP}
_MOST_FURTHER_WORKERS = 2
_LONGEST_TRUCE_SECONDS = 20.0
_LONGEST_SIEGE_SECONDS = 8.0


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault that was committed.

    Attributes:
        kind: see the module.
        at: time on the monotonic clock.
        consumer: number of the consumer that it hit, if any.
    """

    kind: str
    at: float
    consumer: int | None = None

    @property
    def is_kill(self) -> bool:
        """Return whether it ended the process, at once or by the watchdog."""
        return self.kind.partition("-")[2] in _SIGNALS


@dataclass(slots=True)
class Chaos:
    """Choose and commit faults.

    Args:
        fleet: the processes.
        mean_seconds: between two faults; gaps are exponentially distributed, and longer until a consumer gets a batch.
        seed: of all choices.
        most_segv: largest number of SIGSEGV faults.
        kinds: to choose from.

    Attributes:
        done: all faults so far.
    """

    fleet: Fleet
    mean_seconds: float
    seed: int
    most_segv: int
    kinds: tuple[str, ...] = tuple(WEIGHTS)
    done: list[Fault] = field(default_factory=list)
    _random: random.Random = field(init=False)
    _next: float | None = field(init=False, default=None)
    _last: float = field(init=False, default=0.0)
    _logged: int = field(init=False, default=0)
    _lasting: list[tuple[float, Callable[[], None]]] = field(init=False, default_factory=list)
    _siege_until: float = field(init=False, default=0.0)

    def __post_init__(self) -> None:
        self._random = random.Random(self.seed)

    def act(self, now: float) -> None:
        """Do what is due; must be called often."""
        self._end_those_due(now)
        if self._next is not None and now >= self._next and self._progressed(now):
            possible = [kind for kind in self.kinds if self._possible(kind, now)]
            if possible:
                kind = self._random.choices(possible, [WEIGHTS[kind] for kind in possible])[0]
                self._commit(kind, now)
            self._next = None
        if self._next is None:
            self._next = now + self._random.expovariate(1.0 / self.mean_seconds)
            self._last, self._logged = now, self.fleet.logged_bytes()

    def _progressed(self, now: float) -> bool:
        """Return whether a consumer got a batch since the last fault.

        On a busy host, workers that are killed during their start would otherwise never make a sample.
        """
        return self.fleet.logged_bytes() != self._logged or now - self._last > _LONGEST_TRUCE_SECONDS

    def end(self) -> None:
        """End all faults: continue paused processes, end hostile peers."""
        self._end_those_due(math.inf)

    def _end_those_due(self, now: float) -> None:
        for until, end in self._lasting:
            if until <= now:
                end()
        self._lasting = [(until, end) for until, end in self._lasting if until > now]

    def _possible(self, kind: str, now: float) -> bool:
        who, _, how = kind.partition("-")
        if how == "segv" and sum(fault.kind == kind for fault in self.done) >= self.most_segv:
            return False
        if who == "worker" and not self.fleet.pool:
            return bool(self.fleet.server_workers())
        if who == "server":
            # Kill only a ready server: otherwise a busy host may never serve the corpus.
            return self.fleet.is_ready
        if who == "peers":
            return now >= self._siege_until
        if who == "cache":
            return bool(self.fleet.cached_pieces())
        if how == "add":
            return len(self.fleet.further_workers) < _MOST_FURTHER_WORKERS
        return how != "hang" and any(place.pid is not None for place in self._places(who))

    def _places(self, who: str) -> list[Process]:
        fleet = self.fleet
        return {
            "server": fleet.servers, "worker": fleet.pool, "further": fleet.further_workers, "consumer": fleet.crowd
        }[who]  # fmt: skip

    def _commit(self, kind: str, now: float) -> None:
        who, _, how = kind.partition("-")
        consumer = None
        if how == "add":
            self.fleet.add_worker()
        elif who == "peers":
            self._siege_until = now + self._random.uniform(0.3, 1.0) * _LONGEST_SIEGE_SECONDS
            siege = contextlib.ExitStack()
            siege.enter_context(self.fleet.attacked(how))
            self._lasting.append((self._siege_until, siege.close))
        elif who == "cache":
            self._spoil(how)
        elif who == "worker" and not self.fleet.pool:
            pids = self.fleet.server_workers()
            if not pids:
                return  # the last one has ended meanwhile
            self._signal(self._random.choice(pids), how, now)
        else:
            alive = [(place, place.pid) for place in self._places(who)]
            place, pid = self._random.choice([(place, pid) for place, pid in alive if pid is not None])
            place.expected = how != "pause"
            consumer = self.fleet.crowd.index(place) if who == "consumer" else None
            self._signal(pid, how, now)
        self.done.append(Fault(kind, now, consumer))

    def _spoil(self, how: str) -> None:
        folder, pieces = self.fleet.clip_cache, self.fleet.cached_pieces()
        if folder is None or not pieces:
            return  # a worker removed the last one meanwhile
        if how == "delete":
            shutil.rmtree(folder, ignore_errors=True)
            return
        with contextlib.suppress(OSError), self._random.choice(pieces).open("r+b") as piece:
            at = self._random.randrange(max(1, os.fstat(piece.fileno()).st_size))
            if how == "cut":
                piece.truncate(at)
                return
            piece.seek(at)
            old = piece.read(1)
            piece.seek(at)
            piece.write(bytes([old[0] ^ (1 << self._random.randrange(8))]) if old else b"")

    def _signal(self, pid: int, how: str, now: float) -> None:
        if how == "pause":
            longest = (
                2.0 * self.fleet.lease_deadline_seconds
                if pid in {place.pid for place in (*self.fleet.further_workers, *self.fleet.pool)}
                else 4.0
            )
            self._lasting.append((now + self._random.uniform(0.2, longest), partial(_send, pid, signal.SIGCONT)))
        _send(pid, _SIGNALS.get(how, signal.SIGSTOP))


def _send(pid: int, number: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError):  # it has ended already
        os.kill(pid, number)
