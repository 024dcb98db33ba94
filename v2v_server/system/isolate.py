"""Apply a function to many jobs in separate processes, so that a crash costs only the job that caused it.

It uses programs of its own and socket pairs only. :mod:`multiprocessing` would run the user's script again in each
process, and its locks, queues and shared memory need a writable ``/dev/shm``, which some containers do not have.

A process that a hostile video has taken over costs only its job too. Jobs and results travel as msgpack, which executes
nothing (:mod:`v2v_protocol.persisted`). The function's annotations say which types they have. A result of another type
or size counts as the death of its process, and waiting for the rest of a message counts as waiting for the result.
"""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, suppress
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from multiprocessing.connection import wait
from operator import attrgetter
from pathlib import Path
from socket import MSG_WAITALL, socket, socketpair
from typing import Any, Generic, TypeVar, get_type_hints

import msgpack

from v2v_protocol.errors import UsageError, V2VError, undo_on_error
from v2v_protocol.persisted import reader, to_plain
from v2v_server.system.process import die_with_parent, limit_memory, relayed_output
from v2v_server.system.sandbox import confine

J = TypeVar("J")
T = TypeVar("T")
_R = TypeVar("_R")

LARGEST_MESSAGE_BYTES = 64 << 20
"""Size limit of a job or result. The largest in use holds the frame index of a video of 2**24 frames."""
_PROGRAM = (
    "import sys; sys.path[:] = sys.argv[2:]; from v2v_server.system.isolate import serve; serve(int(sys.argv[1]))"
)
"""What a process runs. Its arguments are its end of the socket pair, and where this process finds modules."""
_LIMITS: Mapping[str, Any] = {
    "max_buffer_size": LARGEST_MESSAGE_BYTES,
    "max_str_len": 1 << 16,
    "max_array_len": 1 << 17,
    "max_map_len": 64,
    "max_ext_len": 0,
    "use_list": False,
}
"""What is unpacked takes at most thirty times the memory of its message."""
_CHUNK_BYTES = 1 << 18
_LENGTH_BYTES = 8
"""Before a process's first message, which may have any size: its length."""
_SETUP = tuple[str, str, tuple[bytes, ...], int, int, tuple[Path, ...] | None]
"""What a process is told first: module and name of its function, the function's first arguments, each packed, the id
of its parent, and ``memory_bytes`` and ``writable`` of :func:`run_isolated`."""
_SEND_SECONDS = 60.0
_EXIT_SECONDS = 5.0
_LONGEST_WAIT_SECONDS = 10.0
_FROM_OUTSIDE = (signal.SIGKILL, signal.SIGTERM, signal.SIGHUP)
_NO_START = (
    "a process that reads videos ended during its start ({how}): every other one would too. What it printed before "
    "says why; v2v-doctor checks the installation"
)


@dataclass(frozen=True, slots=True)
class Died:
    """Result of a job whose process died.

    Attributes:
        exitcode: the exit status, or minus the number of a signal.
        overdue_seconds: time after which it was ended here; 0 if it died by itself.
        begun: whether the process had started when it died, so that it was working on the job.
        is_malformed: whether it was ended here because its result was malformed or too large.
    """

    exitcode: int
    overdue_seconds: float = 0.0
    begun: bool = True
    is_malformed: bool = False

    @property
    def how(self) -> str:
        """``signal SIGSEGV``, ``exit status 1``, ``ended after 60 s without a result``."""
        if self.is_malformed:
            return "it sent a malformed result"
        if self.overdue_seconds:
            return f"ended after {self.overdue_seconds:.0f} s without a result"
        if self.exitcode >= 0:
            return f"exit status {self.exitcode}"
        number = -self.exitcode
        return f"signal {signal.Signals(number).name if number in set(signal.Signals) else number}"

    @property
    def is_crash(self) -> bool:
        """Return whether the job is to blame: a signal that the process caused itself struck it at work, or its result
        was malformed.

        Otherwise it was killed from outside, the kernel was short of memory, it was overdue, or it exited with a
        status: an exception of this program, or a broken installation.
        """
        struck = self.exitcode < 0 and not self.overdue_seconds and -self.exitcode not in _FROM_OUTSIDE
        return self.begun and (struck or self.is_malformed)


def run_isolated(
    function: Callable[[J], _R],
    jobs: Iterable[J],
    processes: int,
    deadline_seconds: Callable[[J], float] | None = None,
    memory_bytes: int = 0,
    writable: Sequence[Path] | None = None,
) -> Generator[tuple[J, _R | Died], None, None]:
    """Yield (job, result) for every job, in order of completion.

    A process takes one job after another; a process that dies is replaced. All are ended with the iterator, and die
    with this process, however it ends. Ctrl-C reaches only this process.

    Args:
        function: of a module that can be imported, or a ``partial`` of one with positional arguments. It must return
            rather than raise: an exception counts as its process's death. The annotations of its parameters and its
            result are the types of arguments, jobs (the last parameter) and results: those that
            :mod:`v2v_protocol.persisted` reads.
        jobs: drawn as processes become free.
        processes: number of processes; 0 runs the jobs in this process, unprotected.
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
    left = iter(jobs)
    lanes: list[_Lane[J, _R]] = []
    try:
        for job in left:
            lanes.append(_Lane(function, deadline_seconds, memory_bytes, writable))
            lanes[-1].begin(job)
            if len(lanes) == processes:
                break
        while lanes:
            readable = _wait(lanes)
            for lane in list(lanes):
                finished = lane.receive() if lane.socket in readable else None
                if finished is None and lane.patience <= 0:
                    finished = lane.give_up()
                if finished is None:
                    continue
                for following in left:
                    if isinstance(finished[1], Died):
                        lanes.append(_Lane(function, deadline_seconds, memory_bytes, writable))
                        lanes.remove(lane)
                        lane.end()
                        lane = lanes[-1]
                    lane.begin(following)
                    break
                else:
                    lanes.remove(lane)
                    lane.end()
                yield finished
    finally:
        for lane in lanes:
            lane.end()


def run_twice(
    function: Callable[[J], _R], jobs: Iterable[J], processes: int, **limits: Any
) -> Iterator[tuple[J, _R | Died]]:
    """Do the same, but try a job once more if its process died or its result is None: after all others, alone. The
    process may have been killed from outside, memory was too short for it and its neighbours, or storage failed.
    """
    suspects: list[J] = []
    for job, result in run_isolated(function, jobs, processes, **limits):
        if result is None or (isinstance(result, Died) and not result.overdue_seconds):
            suspects.append(job)
        else:
            yield job, result
    yield from run_isolated(function, suspects, min(processes, 1), **limits)


def run_lent(
    function: Callable[[J], _R],
    items: Iterable[T],
    lend: Callable[[T], AbstractContextManager[J]],
    processes: int,
    **limits: Any,
) -> Iterator[tuple[T, _R | Died | V2VError | OSError]]:
    """Do the same for items whose jobs need something of this process, such as bytes from a network, which a confined
    process has not.

    Args:
        items: drawn as processes become free.
        lend: makes the job of an item; the context ends when its result is there.

    Yields:
        each item with its result. An error of its context counts instead, also one at the end.
    """
    failed, lent = list[tuple[T, V2VError | OSError]](), dict[int, tuple[T, ExitStack]]()

    def jobs() -> Iterator[J]:
        for item in items:
            with ExitStack() as stack:
                try:
                    job = stack.enter_context(lend(item))
                except (V2VError, OSError) as error:
                    failed.append((item, error))
                    continue
                lent[id(job)] = item, stack.pop_all()
                yield job

    try:
        with closing(run_isolated(function, jobs(), processes, **limits)) as results:
            for job, result in results:
                item, stack = lent.pop(id(job))
                found: _R | Died | V2VError | OSError = result
                try:
                    stack.close()
                except (V2VError, OSError) as error:
                    found = error
                yield item, found
    finally:  # once the processes have ended
        for _, stack in lent.values():
            stack.close()
    yield from failed


def _wait(lanes: list[_Lane[J, _R]]) -> list[Any]:
    """Wait until there is a part of a result or a job is overdue, but not for long; return the readable sockets."""
    at_most = max(0.0, min(_LONGEST_WAIT_SECONDS, *(lane.patience for lane in lanes)))
    started = time.monotonic()
    readable = wait([lane.socket for lane in lanes], at_most)
    spent = min(time.monotonic() - started, at_most)
    for lane in lanes:
        lane.patience -= spent
    return readable


class _Lane(Generic[J, _R]):
    """One process and its job.

    Attributes:
        socket: our end of the pair.
        patience: remaining seconds until its job is overdue.
    """

    def __init__(
        self,
        function: Callable[[J], _R],
        deadline_seconds: Callable[[J], float] | None,
        memory_bytes: int,
        writable: Sequence[Path] | None,
    ) -> None:
        self._deadline_seconds = deadline_seconds
        self._function = function
        self.patience = math.inf
        self._begun = False
        called: Any = getattr(function, "func", function)
        bound = tuple(map(_packed, getattr(function, "args", ())))
        folders = None if writable is None else tuple(writable)
        setup = _packed((called.__module__, called.__qualname__, bound, os.getpid(), memory_bytes, folders))
        self._unsent = len(setup).to_bytes(_LENGTH_BYTES) + setup
        self.socket, other = socketpair()
        self.socket.settimeout(_SEND_SECONDS)
        with undo_on_error(self.socket.close), closing(other):
            self._process = subprocess.Popen(
                [sys.executable, "-c", _PROGRAM, str(other.fileno()), *sys.path],
                stdin=subprocess.DEVNULL,
                stdout=relayed_output().fileno(),
                stderr=subprocess.STDOUT,
                pass_fds=[other.fileno()],
                start_new_session=True,  # no terminal sends it a signal; this process decides what follows a Ctrl-C
            )

    def begin(self, job: J) -> None:
        self._job = job
        self._allowed = self.patience = math.inf if self._deadline_seconds is None else self._deadline_seconds(job)
        self._unpacker = msgpack.Unpacker(**_LIMITS)
        try:
            self.socket.sendall(self._unsent + _packed(job))
        except OSError:
            self._process.kill()  # it has died, or does not read: receive() finds the end
        self._unsent = b""

    def receive(self) -> tuple[J, _R | Died] | None:
        """Return the job and its result if the rest of it has arrived; None otherwise."""
        try:
            data = self.socket.recv(_CHUNK_BYTES)
        except OSError:
            data = b""
        if not data:
            self._wait()
            death = self._kill()
            if not self._begun and death.exitcode >= 0:
                raise UsageError(_NO_START.format(how=death.how))
            return self._job, death
        try:
            self._unpacker.feed(data)
            if not self._begun:
                self._begun = self._unpacker.unpack() is None
            result: _R = reader(_hints(self._function)["return"])(self._unpacker.unpack())
            if self._unpacker.read_bytes(1):
                raise ValueError("more than one result")
        except msgpack.OutOfData:
            return None
        except Exception:  # noqa: BLE001 - a process that a video has taken over sends anything
            return self._job, replace(self._kill(), is_malformed=True)
        return self._job, result

    def give_up(self) -> tuple[J, _R | Died]:
        return self._job, replace(self._kill(), exitcode=-signal.SIGKILL, overdue_seconds=self._allowed)

    def _kill(self) -> Died:
        self._process.kill()
        self._wait()
        return Died(self._process.returncode or 0, begun=self._begun)

    def _wait(self) -> None:
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_EXIT_SECONDS)

    def end(self) -> None:
        self._process.kill()
        self._process.wait()
        self.socket.close()


def serve(descriptor: int) -> None:
    """Do jobs for the process that started this one, until it closes the connection.

    Args:
        descriptor: of this end of the connection.
    """
    connection = socket(fileno=descriptor)
    size = int.from_bytes(connection.recv(_LENGTH_BYTES, MSG_WAITALL))
    if not size:
        return  # the parent has ended
    setup = msgpack.unpackb(connection.recv(size, MSG_WAITALL))
    module, name, packed, parent_pid, memory_bytes, writable = reader(_SETUP)(setup)
    die_with_parent(parent_pid)
    function = attrgetter(name)(import_module(module))
    *kinds, job_kind, _ = _hints(function).values()
    bound = [reader(kind)(msgpack.unpackb(value)) for kind, value in zip(kinds, packed, strict=True)]
    if memory_bytes:
        limit_memory(memory_bytes)
    if writable is not None:
        confine(writable, network=False)
    connection.sendall(_packed(None))  # report that it began: from here on, its end is not a failed start
    for job in msgpack.Unpacker(connection.makefile("rb", buffering=0), **_LIMITS):
        connection.sendall(_packed(function(*bound, reader(job_kind)(job))))


def _hints(function: Callable[..., Any]) -> dict[str, Any]:
    """Return the types of a function's parameters, in order, and of its result."""
    return get_type_hints(getattr(function, "func", function), include_extras=True)


_packed: Callable[[Any], bytes] = partial(msgpack.packb, default=to_plain)
