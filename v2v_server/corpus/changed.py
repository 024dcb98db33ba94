"""Which files are new or changed since the index was written: asks the system for the size and times of each.

Of a million files that takes seconds, so other processes help. They are started by a command of their own: a script
that opens a catalogue needs no guard for them, and a loader's worker, which may have no children of multiprocessing,
has them too.

    python -m v2v_server.corpus.changed      jobs come in on stdin, the answer goes out on stdout, in msgpack
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from array import array
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from types import TracebackType

import msgpack

from v2v_protocol.programs import environment
from v2v_server.corpus.sources.asking import Notice, by_parts
from v2v_server.corpus.sources.source import VideoSource, open_source
from v2v_server.system.process import die_with_parent

_FILES_A_PROCESS = 50_000
"""For fewer another process costs more than it saves."""
_TOGETHER = 10_000


@dataclass(frozen=True, slots=True)
class _Some:
    """Some of the files.

    Attributes:
        source: where the videos come from.
        first: number of the first of them.
        ids: relative paths.
        states: that the index knows, size, mtime and ctime of each, one after the other.
    """

    source: VideoSource
    first: int
    ids: Sequence[str]
    states: array[int]


def changed(
    source: VideoSource, ids: Sequence[str], states: array[int], processes: int, notice: Notice | None
) -> list[int]:
    """The numbers of the files that are not as the index knows them, rising.

    Args:
        source: where the videos come from.
        ids: relative paths.
        states: that the index knows, size, mtime and ctime of each, one after the other.
        processes: how many may ask, this one among them.
        notice: told how far it is.
    """
    shares = max(1, min(processes if source.is_local else 1, len(ids) // _FILES_A_PROCESS))
    ends = [len(ids) * share // shares for share in range(shares + 1)]

    def some(share: int) -> Iterator[_Some]:
        for start in range(ends[share], ends[share + 1], _TOGETHER):
            end = min(start + _TOGETHER, ends[share + 1])
            yield _Some(source, start, ids[start:end], states[3 * start : 3 * end])

    done, found = 0, list[int]()

    def tell(more: int, changed: int) -> None:
        nonlocal done
        done += more
        if notice is not None:
            notice(f"looking at files: {done} of {len(ids)}, {changed} of them new or changed")

    with ExitStack() as helpers:
        others = [helpers.enter_context(_Helper(some(share))) for share in range(1, shares)]
        for mine in some(0):
            found += _changed(mine)
            tell(len(mine.ids), len(found))
        for share, helper in enumerate(others, 1):
            answer = helper.answer()
            found += [number for theirs in some(share) for number in _changed(theirs)] if answer is None else answer
            tell(ends[share + 1] - ends[share], len(found))
    return found


class _Helper:
    """A process that looks at some of the files meanwhile."""

    def __init__(self, jobs: Iterable[_Some]) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        command = [sys.executable, "-m", __name__]
        with suppress(OSError):  # it does not start, or ends at once: whoever asks it does the work
            self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment())
            assert self._process.stdin is not None
            self._process.stdin.write(msgpack.packb(os.getpid()))
            for job in jobs:
                given = job.source.name, job.first, job.ids, job.states.tobytes()
                self._process.stdin.write(msgpack.packb(given, unicode_errors="surrogateescape"))
            self._process.stdin.close()

    def answer(self) -> list[int] | None:
        """What it found; None if it ended without an answer."""
        if self._process is None or self._process.stdout is None:
            return None
        try:
            answer: list[int] = msgpack.unpackb(self._process.stdout.read())
        except (OSError, ValueError, msgpack.UnpackException):
            return None
        return answer

    def __enter__(self) -> _Helper:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._process is not None:
            self._process.kill()
            for pipe in (self._process.stdin, self._process.stdout):
                with suppress(OSError):  # what it was not told any more
                    if pipe is not None:
                        pipe.close()
            self._process.wait()


def _changed(some: _Some) -> list[int]:
    found = array("q")
    for _, those in by_parts(some.source.states, some.ids):
        found += those
    if found == some.states and -1 not in found[::3]:
        return []
    return [
        some.first + at
        for at in range(len(some.ids))
        if found[3 * at] < 0 or found[3 * at : 3 * at + 3] != some.states[3 * at : 3 * at + 3]
    ]


def _help() -> None:
    """Reads all jobs before it begins: who asks has work of its own."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to all; who asked decides what follows
    given = msgpack.Unpacker(sys.stdin.buffer, unicode_errors="surrogateescape")
    die_with_parent(next(given))
    jobs = [_Some(open_source(name), first, ids, array("q", states)) for name, first, ids, states in given]
    sys.stdout.buffer.write(msgpack.packb([number for job in jobs for number in _changed(job)]))


if __name__ == "__main__":
    _help()
