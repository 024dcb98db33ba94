"""Apply a function to many jobs in separate processes, so that a crash costs only the job that caused it.

It uses spawned processes and pipes only. Locks, queues and shared memory need a writable ``/dev/shm``, which some
containers do not have.
"""

from __future__ import annotations

import contextlib
import math
import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Generic, TypeVar

from v2v_protocol.errors import UsageError
from v2v_server.system.process import die_with_parent, limit_memory
from v2v_server.system.sandbox import confine

J = TypeVar("J")
R = TypeVar("R")

_EXIT_SECONDS = 5.0
_LONGEST_WAIT_SECONDS = 10.0
_FROM_OUTSIDE = (signal.SIGKILL, signal.SIGTERM, signal.SIGHUP)
_NO_START = (
    "a process that reads videos ended during its start ({how}). In a script, open "
    'videos below `if __name__ == "__main__":`, because each such process imports the script again'
)


@dataclass(frozen=True, slots=True)
class Died:
    """Result of a job whose process died.

    Attributes:
        exitcode: as in ``multiprocessing``: the exit status, or minus the number of a signal.
        overdue_seconds: time after which it was ended here; 0 if it died by itself.
        begun: whether the process had started when it died, so that it was working on the job.
    """

    exitcode: int
    overdue_seconds: float = 0.0
    begun: bool = True

    @property
    def how(self) -> str:
        """``signal SIGSEGV``, ``exit status 1``, ``ended after 60 s without a result``."""
        if self.overdue_seconds:
            return f"ended after {self.overdue_seconds:.0f} s without a result"
        if self.exitcode >= 0:
            return f"exit status {self.exitcode}"
        number = -self.exitcode
        return f"signal {signal.Signals(number).name if number in set(signal.Signals) else number}"

    @property
    def is_crash(self) -> bool:
        """Return whether the job is to blame: a signal that the process caused itself struck it at work.

        Otherwise it was killed from outside, the kernel was short of memory, it was overdue, or it exited with a
        status: an exception of this program, or a broken installation.
        """
        return self.begun and self.exitcode < 0 and not self.overdue_seconds and -self.exitcode not in _FROM_OUTSIDE


def run_isolated(
    function: Callable[[J], R],
    jobs: Iterable[J],
    processes: int,
    deadline_seconds: Callable[[J], float] | None = None,
    memory_bytes: int = 0,
    writable: Sequence[Path] | None = None,
) -> Iterator[tuple[J, R | Died]]:
    """Yield (job, result) for every job, in order of completion.

    A process takes one job after another; a process that dies is replaced. All are ended with the iterator, and die
    with this process, however it ends. Ctrl-C reaches only this process.

    Args:
        function: must be picklable, and return rather than raise: an exception counts as its process's death.
        jobs: picklable; drawn as processes become free.
        processes: number of spawned processes; 0 runs the jobs in this process, unprotected.
        deadline_seconds: time limit of a job, including its process's start, before the process is killed; None: no
            limit. Only time spent waiting here counts, so no job is overdue because the whole program was stopped.
        memory_bytes: limit of a process's allocations; 0 sets no limit.
        writable: what a process may write to, while it may otherwise only read, compute and answer
            (:mod:`v2v_server.system.sandbox`); None: no restrictions.

    Raises:
        OSError: no process can be started.
        UsageError: a process exited with a status before it took its job, so another one would do the same.
    """
    if processes == 0:
        yield from ((job, function(job)) for job in jobs)
        return
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        raise SystemExit(1)  # this is such a process, and imports a script without a main guard: its parent says so
    left = iter(jobs)
    lanes: dict[Connection, _Lane[J, R]] = {}
    try:
        for job in left:
            lane = _Lane(function, deadline_seconds, memory_bytes, writable)
            lanes[lane.connection] = lane
            lane.begin(job)
            if len(lanes) == processes:
                break
        while lanes:
            _wait(lanes)
            for ready in [connection for connection, lane in lanes.items() if connection.poll() or lane.patience <= 0]:
                lane = lanes[ready]
                finished = lane.finish() if ready.poll() else lane.give_up()
                if finished is None:
                    continue
                for following in left:
                    if isinstance(finished[1], Died):
                        lane = _Lane(function, deadline_seconds, memory_bytes, writable)
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


def _wait(lanes: dict[Connection, _Lane[J, R]]) -> None:
    """Wait until there is a result or a job is overdue, but not for long."""
    at_most = max(0.0, min(_LONGEST_WAIT_SECONDS, *(lane.patience for lane in lanes.values())))
    started = time.monotonic()
    wait(list(lanes), at_most)
    spent = min(time.monotonic() - started, at_most)
    for lane in lanes.values():
        lane.patience -= spent


class _Lane(Generic[J, R]):
    """One process and its job.

    Attributes:
        patience: remaining seconds until its job is overdue.
    """

    def __init__(
        self,
        function: Callable[[J], R],
        deadline_seconds: Callable[[J], float] | None,
        memory_bytes: int,
        writable: Sequence[Path] | None,
    ) -> None:
        self._deadline_seconds = deadline_seconds
        self.patience = math.inf
        self._begun = False
        context = multiprocessing.get_context("spawn")
        self.connection, other = context.Pipe()
        given = other, function, os.getpid(), memory_bytes, writable
        self._process = context.Process(target=_serve, args=given, daemon=True)
        # The first process also starts multiprocessing's tracker, which would unblock SIGINT again.
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
        self._allowed = self.patience = math.inf if self._deadline_seconds is None else self._deadline_seconds(job)
        try:
            self.connection.send(job)
        except OSError:
            return  # it died before it received the job: finish() finds the end of the pipe

    def finish(self) -> tuple[J, R | Died] | None:
        """Return the result of the job; None if the process has only reported that it began."""
        try:
            result = self.connection.recv()
        except (EOFError, OSError):
            self._process.join()
            death = Died(self._process.exitcode or 0, begun=self._begun)
            if not death.begun and death.exitcode >= 0:
                raise UsageError(_NO_START.format(how=death.how)) from None
            return self._job, death
        if self._begun:
            return self._job, result
        self._begun = True
        return None

    def give_up(self) -> tuple[J, R | Died]:
        self._process.kill()
        self._process.join(_EXIT_SECONDS)
        return self._job, Died(-signal.SIGKILL, self._allowed, self._begun)

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
    """Block SIGINT for processes started inside. Ctrl-C in a terminal goes to all of them, and must not strike before
    :func:`_serve` can ignore it. In this process it takes effect at the end.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(
    connection: Connection,
    function: Callable[[Any], Any],
    parent_pid: int,
    memory_bytes: int,
    writable: Sequence[Path] | None,
) -> None:
    die_with_parent(parent_pid)
    if memory_bytes:
        limit_memory(memory_bytes)
    if writable is not None:
        confine(writable, network=False)
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # a terminal sends it to all processes; the parent decides what follows
    connection.send(None)  # report that it began: from here on, its end is not a failed start
    while True:
        try:
            job = connection.recv()
        except EOFError:
            return
        connection.send(function(job))
