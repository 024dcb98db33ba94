"""The workers as far as is known: who is there, who has room, who is silent. No I/O; time is passed in."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from v2v_protocol.liveness import Liveness
from v2v_protocol.messages import Result, WorkerHello
from v2v_server.broker.blame import runs_alone
from v2v_server.broker.counters import WorkDone
from v2v_server.broker.leases import LeaseBook

MOST_WORKERS = 4096
MOST_WORKER_CREDIT = 64
SILENCE_SECONDS = 30.0
"""A worker without work says so every five seconds; after this long without a word it is taken for gone."""
REST_SECONDS = 10.0
"""A worker whose host cannot read what the server's can gets no work for so long: storage may come back."""
LONGEST_NAME = 100
"""Characters that are kept of what a peer calls itself or its host."""
_MOST_STALE = 64
"""Entries out of date that the heap may hold, besides one for each worker with room, before it is made anew."""


@dataclass(slots=True)
class Member:
    """A worker that said hello.

    Attributes:
        name: as it says hello, and as its supervisor knows it.
        credit: leases it takes at a time.
        liveness: when it was last heard.
        host: where it says it is.
        user: name of the key that its connection has; empty without keys, and for a worker of this host.
        owner: digest of that and of the secret of its hello; empty without a secret.
        given_up: it hangs or is silent, and gets no more work.
        unreadable: what its host could not read last; empty since it has done anything.
        work: what its samples took that were waited for.
        memory_bytes: of its process when it last said so; 0: not known.
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


def shown(text: str) -> str:
    """What a peer calls itself, fit for a person's eyes: short, and without control characters."""
    return "".join(filter(str.isprintable, text[:LONGEST_NAME]))


class Workers:
    """Workers that said hello and are alive as far as is known.

    Args:
        leases: what they hold.
    """

    def __init__(self, leases: LeaseBook) -> None:
        self._leases = leases
        self._workers: dict[bytes, Member] = {}
        self._names: dict[str, bytes] = {}
        self._resting: dict[bytes, float] = {}  # until when
        # Of a thousand workers only those are looked at whose load has changed, and who holds least is found at once.
        self._changed: set[bytes] = set()
        self._room: dict[bytes, int] = {}  # what they hold who have room for more
        self._heap: list[tuple[int, bytes]] = []  # all of that, and what was so once
        self._in_heap: set[tuple[int, bytes]] = set()

    def __len__(self) -> int:
        return len(self._workers)

    def __contains__(self, identity: bytes) -> bool:
        return identity in self._workers

    def identities(self) -> list[bytes]:
        """All of them."""
        return list(self._workers)

    def members(self) -> Mapping[bytes, Member]:
        """All of them, and what is known of each."""
        return self._workers

    def name_of(self, identity: bytes) -> str:
        """Return the name of a worker; empty if it has not said hello."""
        worker = self._workers.get(identity)
        return "" if worker is None else worker.name

    def named(self, name: str) -> bytes | None:
        """Return the routing id of the worker of that name; None if there is none."""
        return self._names.get(name)

    def is_resting(self, identity: bytes) -> bool:
        """Whether it gets no work for a while."""
        return identity in self._resting

    def add(self, identity: bytes, hello: WorkerHello, now: float, user: str = "", owner: bytes = b"") -> None:
        """Add a worker that said hello; none of that routing id or name is there."""
        room = max(1, min(hello.credit, MOST_WORKER_CREDIT))
        liveness = Liveness(now, gone_seconds=SILENCE_SECONDS)
        self._workers[identity] = Member(hello.name, room, liveness, shown(hello.host), user, owner)
        self._names[hello.name] = identity
        self._changed.add(identity)

    def remove(self, identity: bytes) -> None:
        """It is gone."""
        worker = self._workers.pop(identity, None)
        if worker is not None:
            del self._names[worker.name]
        self._resting.pop(identity, None)
        self._changed.add(identity)

    def heard(self, identity: bytes, now: float) -> bool:
        """A message came from it; False when nobody of that name said hello."""
        worker = self._workers.get(identity)
        if worker is None:
            return False
        worker.liveness.heard(now)
        return True

    def worked(self, identity: bytes, result: Result, cpu_seconds: float) -> None:
        """It made a sample that was waited for."""
        worker = self._workers.get(identity)
        if worker is not None:
            worker.work.add(result, cpu_seconds)
            worker.memory_bytes = result.memory_bytes

    def can_work(self, identity: bytes) -> None:
        """It has done something: its host can read videos."""
        if identity in self._workers:
            self._workers[identity].unreadable = ""

    def trouble(self, expected: int) -> str:
        """Why none of them can make a sample, and what to do about it; empty where one can, as far as is known.

        Args:
            expected: how many there should be.
        """
        if not self._workers:
            start = f"{expected} should come; see what v2v-serve says of them" if expected else "start v2v-worker"
            return f"no worker is connected to the server: {start}, or v2v-serve with --workers N"
        reasons = [worker.unreadable for worker in self._workers.values()]
        if not all(reasons):
            return ""
        return (
            f"none of the server's workers ({len(reasons)}) can read its videos: {reasons[0]:.300}; give v2v-worker "
            "the folder that v2v-serve has (--videos)"
        )

    def rest(self, identity: bytes, now: float, unreadable: str) -> None:
        """It gets no work for a while: its host could not read that."""
        if identity in self._workers:
            self._workers[identity].unreadable = unreadable
            self._resting[identity] = now + REST_SECONDS
            self._changed.add(identity)

    def wake(self, now: float) -> None:
        """Those that have rested get work again."""
        rested = [identity for identity, until in self._resting.items() if now >= until]
        for identity in rested:
            del self._resting[identity]
        self._changed.update(rested)

    def hanging(self, now: float) -> list[bytes]:
        """Workers with an overdue lease. Each is reported once, and gets no more work."""
        return self._give_up(identity for identity in self._leases.overdue(now) if identity in self._workers)

    def vanished(self, now: float) -> list[bytes]:
        """Workers that hold nothing and have been silent for too long. Each is reported once, and gets no more work."""
        return self._give_up(
            identity
            for identity, worker in self._workers.items()
            if not self._leases.held_by(identity) and worker.liveness.is_gone(now)
        )

    def for_request(self, *, keep_one_empty: bool, other_than: bytes | None = None) -> bytes | None:
        """The worker that holds least and has room for more.

        Args:
            keep_one_empty: a request that runs alone waits: the worker that holds least is left to work itself empty.
            other_than: not this one, which is slow at the request.
        """
        lightest = self._lightest(2 + keep_one_empty)[keep_one_empty:]
        return next((identity for _, identity in lightest if identity != other_than), None)

    def for_lone_request(self) -> bytes | None:
        """A worker that holds nothing."""
        return next((identity for held, identity in self._lightest(1) if not held), None)

    def _give_up(self, found: Iterable[bytes]) -> list[bytes]:
        given_up = [identity for identity in found if not self._workers[identity].given_up]
        for identity in given_up:
            self._workers[identity].given_up = True
        self._changed.update(given_up)
        return given_up

    def _lightest(self, most: int) -> list[tuple[int, bytes]]:
        """(leases held, identity) of those with room who hold least, in that order; equals by name."""
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
            worker, held = self._workers.get(identity), self._leases.held_by(identity)
            if worker is None or worker.given_up or identity in self._resting:
                self._room.pop(identity, None)
                continue
            if held >= worker.credit or self._is_alone(identity):
                self._room.pop(identity, None)
                continue
            self._room[identity] = held
            # An entry that is out of date stays until it comes up, or until there are more of them than of others.
            if (held, identity) not in self._in_heap:
                self._in_heap.add((held, identity))
                heapq.heappush(self._heap, (held, identity))
        if len(self._heap) > 2 * len(self._room) + _MOST_STALE:
            self._heap = [(held, identity) for identity, held in self._room.items()]
            self._in_heap = set(self._heap)
            heapq.heapify(self._heap)

    def _is_alone(self, identity: bytes) -> bool:
        """A request that runs alone leaves no room."""
        return any(runs_alone(request) for request in self._leases.requests_of(identity))
