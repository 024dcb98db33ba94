"""A function applied to many jobs in processes of their own, where a crash costs the one job that caused it.

Spawned processes and pipes, nothing else: no lock, queue or shared memory, all of which need a writable ``/dev/shm``,
and containers exist that have none.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from typing import Any, Generic, TypeVar

from v2v_server.process import die_with_parent

J = TypeVar("J")
R = TypeVar("R")

_EXIT_SECONDS = 5.0
_FROM_OUTSIDE = (signal.SIGKILL, signal.SIGTERM, signal.SIGHUP)


@dataclass(frozen=True, slots=True)
class Died:
    """Stands for the result of a job whose process died.

    Attributes:
        exitcode: as ``multiprocessing`` gives it: the exit status, or minus the number of a signal.
    """

    exitcode: int

    @property
    def how(self) -> str:
        """``signal SIGSEGV``, ``exit status 1``."""
        if self.exitcode >= 0:
            return f"exit status {self.exitcode}"
        number = -self.exitcode
        return f"signal {signal.Signals(number).name if number in set(signal.Signals) else number}"

    @property
    def from_outside(self) -> bool:
        """Whether it was killed by somebody, or by a kernel short of memory, so that the job is not to blame."""
        return -self.exitcode in _FROM_OUTSIDE


def run_isolated(function: Callable[[J], R], jobs: Iterable[J], processes: int) -> Iterator[tuple[J, R | Died]]:
    """(job, result) for every job, in order of completion.

    A process takes one job after another; the one that dies is replaced. All are ended with the iterator, and die with
    this process, however that ends. Ctrl-C reaches only this process.

    Args:
        function: must be picklable, and return rather than raise: an exception counts as its process's death.
        jobs: picklable; drawn as processes become free.
        processes: how many, spawned; 0 runs the jobs in this process, unprotected.

    Raises:
        OSError: no process can be started.
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
                lane = lanes[ready]
                finished = lane.finish()
                for following in left:
                    if isinstance(finished[1], Died):
                        lane = _Lane(function)
                        lanes.pop(ready).end()
                        lanes[lane.connection] = lane
                    lane.begin(following)
                    break
                else:
                    lanes.pop(ready).end()
                yield finished
    finally:
        for lane in lanes.values():
            lane.end()


class _Lane(Generic[J, R]):
    """One process and the job it has."""

    def __init__(self, function: Callable[[J], R]) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, other = context.Pipe()
        self._process = context.Process(target=_serve, args=(other, function, os.getpid()), daemon=True)
        # The first process started brings multiprocessing's tracker along, which would let SIGINT through again.
        resource_tracker.ensure_running()
        try:
            with _interrupt_held_back():
                self._process.start()
        except BaseException:
            self.connection.close()
            raise
        finally:
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
            return self._job, Died(self._process.exitcode or 0)

    def end(self) -> None:
        self.connection.close()
        self._process.terminate()
        self._process.join(_EXIT_SECONDS)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._process.close()


@contextlib.contextmanager
def _interrupt_held_back() -> Iterator[None]:
    """A process started inside inherits that SIGINT waits: Ctrl-C in a terminal, which sends it to all, must not strike
    before :func:`_serve` can ignore it. In this process it strikes at the end."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(connection: Connection, function: Callable[[Any], Any], parent_pid: int) -> None:
    die_with_parent(parent_pid)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to all; the parent decides what follows
    while True:
        try:
            job = connection.recv()
        except EOFError:
            return
        connection.send(function(job))
