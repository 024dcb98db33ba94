"""A function applied to many jobs in processes of their own, where a crash costs the one job that caused it."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any, Generic, TypeVar

from v2v_server.process import die_with_parent

J = TypeVar("J")
R = TypeVar("R")

_EXIT_SECONDS = 5.0


@dataclass(frozen=True, slots=True)
class Died:
    """Stands for the result of a job whose process died.

    Attributes:
        how: "signal SIGSEGV", "exit status 1".
    """

    how: str


def run_isolated(function: Callable[[J], R], jobs: Iterable[J], processes: int) -> Iterator[tuple[J, R | Died]]:
    """(job, result) for every job, in order of completion.

    A process takes one job after another; the one that dies is replaced. All are ended with the iterator, and die with
    this process, however that ends.

    Args:
        function: must be picklable, and return rather than raise: an exception counts as its process's death.
        jobs: picklable; drawn as processes become free.
        processes: how many, spawned; 0 runs the jobs in this process, unprotected.
    """
    if processes == 0:
        yield from ((job, function(job)) for job in jobs)
        return
    left = iter(jobs)
    lanes: dict[Connection, _Lane[J, R]] = {}
    try:
        for job in left:
            lane = _Lane(function)
            lanes[lane.connection] = lane
            lane.begin(job)
            if len(lanes) == processes:
                break
        while lanes:
            wait(list(lanes))
            for ready in [connection for connection in lanes if connection.poll()]:
                lane = lanes.pop(ready)
                job, result = lane.finish()
                following = next(left, None)
                if following is None:
                    lane.end()
                else:
                    if isinstance(result, Died):
                        lane.end()
                        lane = _Lane(function)
                    lanes[lane.connection] = lane
                    lane.begin(following)
                yield job, result
    finally:
        for lane in lanes.values():
            lane.end()


class _Lane(Generic[J, R]):
    """One process and the job it has."""

    def __init__(self, function: Callable[[J], R]) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, other = context.Pipe()
        self._process = context.Process(target=_serve, args=(other, function, os.getpid()), daemon=True)
        self._process.start()
        other.close()

    def begin(self, job: J) -> None:
        self._job = job
        try:
            self.connection.send(job)
        except OSError:
            return  # it died before it had the job: finish() finds the end of the pipe

    def finish(self) -> tuple[J, R | Died]:
        try:
            return self._job, self.connection.recv()
        except (EOFError, OSError):
            self._process.join()
            code = self._process.exitcode or 0
            return self._job, Died(f"signal {signal.Signals(-code).name}" if code < 0 else f"exit status {code}")

    def end(self) -> None:
        self.connection.close()
        self._process.terminate()
        self._process.join(_EXIT_SECONDS)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._process.close()


def _serve(connection: Connection, function: Callable[[Any], Any], parent_pid: int) -> None:
    die_with_parent(parent_pid)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to all; the parent decides what follows
    while True:
        try:
            job = connection.recv()
        except EOFError:
            return
        connection.send(function(job))
