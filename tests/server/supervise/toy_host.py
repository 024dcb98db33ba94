"""A host of workers that are only names: what a new kind of host takes is this file, and a line in ``ENGINES``."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from typing import Any

from v2v_server.broker.leases import Cause, Loss
from v2v_server.supervise.pool import Exit, ProcessStatus


class ToyPlace:
    def __init__(self) -> None:
        self.name, self.address, self.told = "", "", []
        self.end: Exit | None = None
        self.state = "running"

    @property
    def is_running(self) -> bool:
        return bool(self.name) and self.end is None

    def start(self, name: str, address: str) -> None:
        self.name, self.address, self.end = name, address, None

    def take_exit(self) -> Exit | None:
        end, self.end = self.end, None
        if end is not None:
            self.name = ""
        return end

    def status(self, now: float) -> ProcessStatus | None:
        return ProcessStatus(self.state, lease=7, decodes=True, seen_at=now) if self.name else None

    def lend(self, arena: str) -> None:
        self.told.append(f"lend {arena}")

    def leave(self) -> bool:
        self.told.append("leave")
        return bool(self.name)

    def signal(self, number: int) -> None:
        self.told.append(signal.Signals(number).name)
        self.die(Cause.KILLED, -number)

    def release(self) -> None:
        self.told.append("release")

    def die(self, cause: Cause, returncode: int = 1) -> None:
        self.end = Exit(Loss(cause, "died"), returncode)


class ToyHost:
    is_local = False
    status_seconds = 1.0

    def __init__(self) -> None:
        self.places: list[ToyPlace] = []
        self.requested: list[int] = []
        self.is_closed = False

    def place(self, number: int) -> ToyPlace:
        self.places.append(ToyPlace())
        return self.places[-1]

    def request(self, workers: int) -> None:
        self.requested.append(workers)

    def refresh(self, now: float) -> None:
        """Nothing happens by itself."""

    def wait(self, places: Sequence[ToyPlace], seconds: float) -> list[ToyPlace]:
        return list(places)

    def news(self) -> list[str]:
        return ["all workers are toys"]

    def close(self) -> None:
        self.is_closed = True


def make_host(*_: Any) -> ToyHost:
    return ToyHost()
