"""Track the workers: which are connected, have free credit, or are silent. No I/O; time is passed in."""

from __future__ import annotations

import heapq
from collections.abc import Iterable
from dataclasses import dataclass, field

from v2v_protocol.liveness import Liveness
from v2v_protocol.messages import Result, WorkerHello
from v2v_server.broker.leases import LeaseBook, runs_alone

MOST_WORKERS = 4096
MOST_WORKER_CREDIT = 64
SILENCE_SECONDS = 30.0
"""An idle worker pings every five seconds; after this time without a message it is treated as gone."""
REST_SECONDS = 10.0
"""Time without work for a worker whose host cannot read a video that the server's host can; storage may return."""
LONGEST_NAME = 100
"""Characters kept of the name that a peer gives itself or its host."""
_MOST_STALE = 64
"""Stale entries that the heap may hold, besides one for each worker with free credit, before it is rebuilt."""


_MOST_SECONDS = 86_400.0


@dataclass(slots=True)
class WorkDone:
    """Totals of the time that samples took, as reported by the workers.

    Attributes:
        samples: number of samples.
        cpu_seconds: processor time.
        decode_seconds, simulate_seconds, handover_seconds: wall-clock time for decoding clips, for building the arrays,
            and for delivering them to their consumers.
    """

    samples: int = 0
    cpu_seconds: float = 0.0
    decode_seconds: float = 0.0
    simulate_seconds: float = 0.0
    handover_seconds: float = 0.0

    def add(self, result: Result, cpu_seconds: float) -> None:
        """Add one sample."""
        self.samples += 1
        self.cpu_seconds += bounded_seconds(cpu_seconds)
        self.decode_seconds += bounded_seconds(result.decode_seconds)
        self.simulate_seconds += bounded_seconds(result.simulate_seconds)
        self.handover_seconds += bounded_seconds(result.handover_seconds)

    @property
    def busy_seconds(self) -> float:
        """Wall-clock time of all three parts."""
        return self.decode_seconds + self.simulate_seconds + self.handover_seconds


def bounded_seconds(said: float) -> float:
    """Clip a duration that a worker reported to a plausible range: 0 to one day, seconds."""
    return min(max(said, 0.0), _MOST_SECONDS)


@dataclass(slots=True)
class Member:
    """A worker that said hello.

    Attributes:
        name: name from its hello, by which its supervisor knows it.
        credit: number of leases that it accepts at a time.
        liveness: when it was last heard.
        host: the host that it names.
        user: name of the key of its connection; empty without keys, and for a worker of this host.
        owner: digest of user and secret of its hello; empty without a secret.
        given_up: whether it hangs or is silent; then it gets no more work.
        unreadable: why its host could not read the last video; empty once it has made a sample since.
        work: totals of its samples that were wanted.
        memory_bytes: memory of its process as last reported; 0: not known.
    """

    name: str
    credit: int
    liveness: Liveness
    host: str = ""
    user: str = ""
    owner: bytes = b""
    given_up: bool = False
    unreadable: str = ""
    work: WorkDone = field(default_factory=WorkDone)
    memory_bytes: int = 0


def clean_name(text: str) -> str:
    """Make a name that a peer sent safe to display: short, and without control characters."""
    return "".join(filter(str.isprintable, text[:LONGEST_NAME]))


class Workers:
    """Workers that said hello and are alive as far as is known.

    Args:
        leases: the leases that they hold.

    Attributes:
        members: all of them by routing id.
    """

    def __init__(self, leases: LeaseBook) -> None:
        self._leases = leases
        self.members: dict[bytes, Member] = {}
        self._names: dict[str, bytes] = {}
        self._resting: dict[bytes, float] = {}  # time at which their rest ends
        # With a thousand workers, only those whose load has changed are examined; the heap gives the least loaded one.
        self._changed: set[bytes] = set()
        self._room: dict[bytes, int] = {}  # leases held by each worker with free credit
        self._heap: list[tuple[int, bytes]] = []  # the same as a heap, with stale entries
        self._in_heap: set[tuple[int, bytes]] = set()

    def __len__(self) -> int:
        return len(self.members)

    def __contains__(self, identity: bytes) -> bool:
        return identity in self.members

    def name_of(self, identity: bytes) -> str:
        """Return the name of a worker; empty if it has not said hello."""
        worker = self.members.get(identity)
        return "" if worker is None else worker.name

    def named(self, name: str) -> bytes | None:
        """Return the routing id of the worker of that name; None if there is none."""
        return self._names.get(name)

    def is_resting(self, identity: bytes) -> bool:
        """Return whether a worker gets no work for a while."""
        return identity in self._resting

    def add(self, identity: bytes, hello: WorkerHello, now: float, user: str = "", owner: bytes = b"") -> None:
        """Add a worker that said hello; none of that routing id or name is there."""
        room = max(1, min(hello.credit, MOST_WORKER_CREDIT))
        liveness = Liveness(now, gone_seconds=SILENCE_SECONDS)
        self.members[identity] = Member(hello.name, room, liveness, clean_name(hello.host), user, owner)
        self._names[hello.name] = identity
        self._changed.add(identity)

    def remove(self, identity: bytes) -> None:
        """Remove a worker that is gone."""
        worker = self.members.pop(identity, None)
        if worker is not None:
            del self._names[worker.name]
        self._resting.pop(identity, None)
        self._changed.add(identity)

    def mark_heard(self, identity: bytes, now: float) -> bool:
        """Note a message from a worker; return False if it has not said hello."""
        worker = self.members.get(identity)
        if worker is None:
            return False
        worker.liveness.mark_heard(now)
        return True

    def worked(self, identity: bytes, result: Result, cpu_seconds: float) -> None:
        """Add a wanted sample to the worker's totals."""
        worker = self.members.get(identity)
        if worker is not None:
            worker.work.add(result, cpu_seconds)
            worker.memory_bytes = result.memory_bytes

    def can_work(self, identity: bytes) -> None:
        """Note that a worker has made a sample, so its host can read videos."""
        if identity in self.members:
            self.members[identity].unreadable = ""

    def trouble(self, expected: int) -> str:
        """Return why no worker can make a sample, and what to do about it; empty if one can, as far as is known.

        Args:
            expected: number of workers expected.
        """
        if not self.members:
            start = f"{expected} should come; see what v2v-serve says of them" if expected else "start v2v-worker"
            return f"no worker is connected to the server: {start}, or v2v-serve with --workers N"
        reasons = [worker.unreadable for worker in self.members.values()]
        if not all(reasons):
            return ""
        return (
            f"none of the server's workers ({len(reasons)}) can read its videos: {reasons[0]:.300}; give v2v-worker "
            "the folder that v2v-serve has (--videos)"
        )

    def rest(self, identity: bytes, now: float, unreadable: str) -> None:
        """Give a worker no work for a while, because its host could not read a video."""
        if identity in self.members:
            self.members[identity].unreadable = unreadable
            self._resting[identity] = now + REST_SECONDS
            self._changed.add(identity)

    def wake(self, now: float) -> None:
        """Give work again to workers whose rest is over."""
        rested = [identity for identity, until in self._resting.items() if now >= until]
        for identity in rested:
            del self._resting[identity]
        self._changed.update(rested)

    def hanging(self, now: float) -> list[bytes]:
        """Return workers with an overdue lease. Each is returned once, and gets no more work."""
        return self._give_up(identity for identity in self._leases.overdue(now) if identity in self.members)

    def vanished(self, now: float) -> list[bytes]:
        """Return workers without leases that have been silent for too long. Each is returned once, and gets no more
        work.
        """
        return self._give_up(
            identity
            for identity, worker in self.members.items()
            if not self._leases.held_by(identity) and worker.liveness.is_gone(now)
        )

    def for_request(self, *, keep_one_empty: bool, other_than: bytes | None = None) -> bytes | None:
        """Return the worker that holds the fewest leases and has free credit; None if there is none.

        Args:
            keep_one_empty: a request that runs alone waits, so the worker with the fewest leases gets no new ones.
            other_than: a worker to skip, because it is slow at this request.
        """
        lightest = self._lightest(2 + keep_one_empty)[keep_one_empty:]
        return next((identity for _, identity in lightest if identity != other_than), None)

    def for_lone_request(self) -> bytes | None:
        """Return a worker that holds no lease; None if there is none."""
        return next((identity for held, identity in self._lightest(1) if not held), None)

    def _give_up(self, found: Iterable[bytes]) -> list[bytes]:
        given_up = [identity for identity in found if not self.members[identity].given_up]
        for identity in given_up:
            self.members[identity].given_up = True
        self._changed.update(given_up)
        return given_up

    def _lightest(self, most: int) -> list[tuple[int, bytes]]:
        """Return (leases held, routing id) of the workers with free credit, fewest leases first; ties by routing id."""
        self._look_at_changed()
        found: list[tuple[int, bytes]] = []
        while self._heap and len(found) < most:
            entry = heapq.heappop(self._heap)
            if self._room.get(entry[1]) == entry[0]:
                found.append(entry)
            else:
                self._in_heap.remove(entry)
        for entry in found:
            heapq.heappush(self._heap, entry)
        return found

    def _look_at_changed(self) -> None:
        changed, self._changed = self._changed | self._leases.take_changed(), set()
        for identity in changed:
            worker, held = self.members.get(identity), self._leases.held_by(identity)
            if worker is None or worker.given_up or identity in self._resting:
                self._room.pop(identity, None)
                continue
            if held >= worker.credit or self._is_alone(identity):
                self._room.pop(identity, None)
                continue
            self._room[identity] = held
            # A stale entry stays until it reaches the top, or until stale entries outnumber the others.
            if (held, identity) not in self._in_heap:
                self._in_heap.add((held, identity))
                heapq.heappush(self._heap, (held, identity))
        if len(self._heap) > 2 * len(self._room) + _MOST_STALE:
            self._heap = [(held, identity) for identity, held in self._room.items()]
            self._in_heap = set(self._heap)
            heapq.heapify(self._heap)

    def _is_alone(self, identity: bytes) -> bool:
        """Return whether the worker holds a request that runs alone, which leaves no credit."""
        return any(runs_alone(request) for request in self._leases.requests_of(identity))
