"""The workers as far as is known: who is there, who has room, who is silent. No I/O; time is passed in."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from v2v_server.blame import runs_alone
from v2v_server.leases import LeaseBook

MOST_WORKERS = 4096
MOST_WORKER_CREDIT = 64
SILENCE_SECONDS = 30.0
"""A worker without work says so every five seconds; after this long without a word it is taken for gone."""


@dataclass(slots=True)
class _Worker:
    credit: int
    last_heard: float
    given_up: bool = False


class Workers:
    """Workers that said hello and are alive as far as is known.

    Args:
        leases: what they hold.
    """

    def __init__(self, leases: LeaseBook) -> None:
        self._leases = leases
        self._workers: dict[bytes, _Worker] = {}
        # Among a thousand busy workers the one that has just answered is found at once.
        self._may_have_room: set[bytes] = set()

    def __len__(self) -> int:
        return len(self._workers)

    def __contains__(self, identity: bytes) -> bool:
        return identity in self._workers

    def identities(self) -> list[bytes]:
        """All of them."""
        return list(self._workers)

    def add(self, identity: bytes, credit: int, now: float) -> None:
        """A worker said hello."""
        self._workers[identity] = _Worker(max(1, min(credit, MOST_WORKER_CREDIT)), now)
        self._may_have_room.add(identity)

    def remove(self, identity: bytes) -> None:
        """It is gone."""
        self._workers.pop(identity, None)

    def heard(self, identity: bytes, now: float) -> bool:
        """A message came from it; False when nobody of that name said hello."""
        worker = self._workers.get(identity)
        if worker is None:
            return False
        worker.last_heard = now
        return True

    def hanging(self, now: float) -> list[bytes]:
        """Workers with an overdue lease. Each is reported once, and gets no more work."""
        return self._give_up(identity for identity in self._leases.overdue(now) if identity in self._workers)

    def vanished(self, now: float) -> list[bytes]:
        """Workers that hold nothing and have been silent for too long. Each is reported once, and gets no more work."""
        return self._give_up(
            identity
            for identity, worker in self._workers.items()
            if not self._leases.held_by(identity) and now - worker.last_heard > SILENCE_SECONDS
        )

    def for_ordinary_task(self, *, keep_one_empty: bool, other_than: bytes | None = None) -> bytes | None:
        """The worker that holds least and has room for more.

        Args:
            keep_one_empty: a task that runs alone waits: the worker that holds least is left to work itself empty.
            other_than: not this one, which is slow at the task.
        """
        free = sorted(self._free())[int(keep_one_empty) :]
        return next((identity for _, identity in free if identity != other_than), None)

    def for_lone_task(self) -> bytes | None:
        """A worker that holds nothing."""
        return next((identity for held, identity in sorted(self._free()) if not held), None)

    def _give_up(self, found: Iterable[bytes]) -> list[bytes]:
        given_up = [identity for identity in found if not self._workers[identity].given_up]
        for identity in given_up:
            self._workers[identity].given_up = True
        return given_up

    def _free(self) -> list[tuple[int, bytes]]:
        """(leases held, identity) of those with room; a task that runs alone leaves none."""
        self._may_have_room |= self._leases.take_lightened()
        free = []
        for identity in list(self._may_have_room):
            worker = self._workers.get(identity)
            held = self._leases.held_by(identity)
            if worker is None or worker.given_up or held >= worker.credit:
                self._may_have_room.remove(identity)
            elif not any(runs_alone(task) for task in self._leases.tasks_of(identity)):
                free.append((held, identity))
        return free
