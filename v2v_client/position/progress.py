"""Which epoch a dataset is in, agreed between a process and its loader workers.

``DataLoader(num_workers=...)`` copies the dataset into processes of its own, by fork or by pickling, and tells the
original nothing. But an epoch must begin when the last loader worker has finished the one before, a late worker must
begin the epoch that its siblings began, and the original must know that its own state is stale. So all copies share a
log: a small file in memory (a temporary one where the system has none; never in /dev/shm, which may be missing or tiny
in a container) to which each appends whole lines, which the kernel keeps apart, and from which each computes the same
answers. It has no name, so that it is gone with the last process that has it open, however that one ends:

    set     an epoch to be in, and the state to start it from: from the user, or a state that was loaded
    main    the original itself iterates
    start   a loader worker begins an iteration; the first of an iteration to do so decides the epoch for all of it
    finish  a loader worker has delivered its share; when all have, the next epoch begins, unless an epoch was set since
            their iteration began: then theirs was left early, and what they prefetched of it says nothing
    stream  what a server offered first; all others must offer the same

The order of the lines is the order of the events; no lock, no clock.

A rank, or any other process that is no loader worker, may be forked or spawned with the dataset too. Its epochs are its
own, so it goes on with a copy of the log, made before it or a loader worker of its own adds to it.
"""

from __future__ import annotations

import fcntl
import json
import os
import tempfile
import weakref
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from multiprocessing.context import get_spawning_popen
from multiprocessing.reduction import DupFd
from typing import Any

from torch.utils.data import get_worker_info

from v2v_client.position.state import ResumeState, Stream

_READ_BYTES = 1 << 16


@dataclass(slots=True)
class Standing:
    """What the log says so far.

    Attributes:
        epoch: the epoch that the next iteration delivers.
        state: where it begins; None at its beginning.
        stream: what the samples are made of, once known.
        stale: loader workers have begun to iterate since the original last knew where it stood.
    """

    epoch: int = 0
    state: ResumeState | None = None
    stream: Stream | None = None
    stale: bool = False
    loads: dict[tuple[str, int], int] = field(default_factory=dict)
    tokens: set[tuple[str, int]] = field(default_factory=set)
    starts: dict[tuple[str, int], int] = field(default_factory=dict)
    decisions: dict[tuple[str, int], tuple[int, ResumeState | None]] = field(default_factory=dict)
    beginnings: int = 0
    decided_after: dict[tuple[str, int], int] = field(default_factory=dict)  # so many beginnings
    finished: dict[tuple[str, int], set[int]] = field(default_factory=dict)

    def apply(self, line: Mapping[str, Any]) -> None:
        """One more line of the log."""
        match line["kind"]:
            case "set":
                if line["token"] is not None and not self._is_first_of_its_event(line["token"], line["worker"]):
                    return
                self._begin(line["epoch"], line["state"])
                self.stale = self.stale and line["keeps_stale"]
            case "main":
                self.stale = False
            case "start":
                mine = (line["iteration"], line["worker"])
                self.starts[mine] = self.starts.get(mine, 0) + 1
                iteration = (line["iteration"], self.starts[mine])
                self.decisions.setdefault(iteration, (self.epoch, self.state))
                self.decided_after.setdefault(iteration, self.beginnings)
                self.stale = True
            case "finish":
                iteration = (line["iteration"], line["round"])
                if self.decided_after.get(iteration) == self.beginnings:
                    workers = self.finished.setdefault(iteration, set())
                    workers.add(line["worker"])
                    if len(workers) == line["workers"]:
                        self._begin(self.epoch + 1, None)
            case "stream":
                self.stream = self.stream or Stream(**line["stream"])

    def copy(self) -> Standing:
        """One of its own, to be gone on with."""
        return replace(
            self,
            loads=dict(self.loads),
            tokens=set(self.tokens),
            starts=dict(self.starts),
            decisions=dict(self.decisions),
            decided_after=dict(self.decided_after),
            finished={iteration: set(workers) for iteration, workers in self.finished.items()},
        )

    def _is_first_of_its_event(self, token: str, worker: int) -> bool:
        """Whether a loader worker loads what none beside it has loaded yet: each has its own copy of one event. Where a
        loader is restored again, that is another one, although it has the seeds, so the token, of the first time."""
        self.loads[token, worker] = self.loads.get((token, worker), 0) + 1
        event = token, self.loads[token, worker]
        first = event not in self.tokens
        self.tokens.add(event)
        return first

    def _begin(self, epoch: int, state: Mapping[str, Any] | None) -> None:
        self.beginnings += 1
        self.epoch = epoch
        self.state = None if state is None else ResumeState.from_dict(state)
        self.finished = {}
        if self.state is not None and self.state.stream is not None:
            self.stream = self.state.stream


class Progress:
    """The log, as one process sees it. Pickled while a loader worker is being spawned it stays the same log; copied in
    any other way it becomes a log of its own, with the same lines."""

    def __init__(self, epoch: int) -> None:
        self._create()
        self.set(epoch, None)

    def _create(self) -> None:
        if hasattr(os, "memfd_create"):
            descriptor = os.memfd_create("v2v-progress")
        else:
            descriptor, path = tempfile.mkstemp(prefix="v2v-progress-")
            os.unlink(path)
        fcntl.fcntl(descriptor, fcntl.F_SETFL, fcntl.fcntl(descriptor, fcntl.F_GETFL) | os.O_APPEND)
        self._adopt(descriptor, os.getpid())

    def _adopt(self, descriptor: int, process: int) -> None:
        self._descriptor = descriptor
        self._process = process  # whose log it is: its own and that of its loader workers
        self._known = 0, Standing()  # bytes of the log, and what they say
        self._close = weakref.finalize(self, os.close, descriptor)
        _logs.add(self)

    def part(self) -> None:
        """Goes on with a log of its own, if this is that of another process, whose loader worker this one is not."""
        if self._process == os.getpid() or get_worker_info() is not None:
            return
        lines, close = self._lines(0)[0], self._close
        self._create()
        close()
        for line in lines:
            self._append(**line)

    def __getstate__(self) -> dict[str, Any]:
        self.part()
        if get_spawning_popen() is not None:
            return {"descriptor": DupFd(self._descriptor), "process": self._process}
        return {"lines": self._lines(0)[0]}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        if "descriptor" in state:
            self._adopt(state["descriptor"].detach(), state["process"])
            return
        self._create()
        for line in state["lines"]:
            self._append(**line)

    def standing(self) -> Standing:
        """What the log says now. Only what is new is read: a week may have a hundred thousand epochs."""
        self.part()
        end, standing = self._known
        lines, end = self._lines(end)
        if lines:
            standing = standing.copy()  # whoever asked before, in another thread perhaps, has the old one
            for line in lines:
                standing.apply(line)
            self._known = end, standing
        return standing

    def set(
        self, epoch: int, state: ResumeState | None, *, iteration: str | None = None, worker: int | None = None
    ) -> None:
        """The next iteration delivers ``epoch``, from ``state`` on.

        Args:
            iteration, worker: given by loader workers that all load the same state: counts once.
        """
        plain = None if state is None else state.to_dict()
        keeps_stale = iteration is not None
        self._append(kind="set", token=iteration, worker=worker, epoch=epoch, state=plain, keeps_stale=keeps_stale)

    def main(self) -> None:
        """The process that owns the dataset iterates by itself."""
        self._append(kind="main")

    def start(self, iteration: str, worker: int) -> tuple[int, int, ResumeState | None]:
        """A loader worker begins: (its number of this start, the epoch, where the epoch begins)."""
        self._append(kind="start", iteration=iteration, worker=worker)
        standing = self.standing()
        number = standing.starts[iteration, worker]
        return number, *standing.decisions[iteration, number]

    def finish(self, iteration: str, number: int, worker: int, workers: int) -> None:
        """A loader worker has delivered its share of the epoch that was decided for that start."""
        self._append(kind="finish", iteration=iteration, round=number, worker=worker, workers=workers)

    def pin(self, stream: Stream) -> None:
        """A server offered ``stream``."""
        plain = {name: getattr(stream, name) for name in stream.__slots__}
        self._append(kind="stream", stream=plain | {"spec": dict(stream.spec)})

    def _append(self, **line: Any) -> None:
        self.part()
        os.write(self._descriptor, json.dumps(line).encode() + b"\n")

    def _lines(self, start: int) -> tuple[list[dict[str, Any]], int]:
        """The whole lines from a byte on, and the byte after them."""
        # The offset of the descriptor is everybody's, so it is not used.
        content = b""
        while piece := os.pread(self._descriptor, _READ_BYTES, start + len(content)):
            content += piece
        whole = content[: content.rfind(b"\n") + 1]  # what has no end yet is still being written
        return [json.loads(line) for line in whole.splitlines()], start + len(whole)


_logs: weakref.WeakSet[Progress] = weakref.WeakSet()


def _part_before_fork() -> None:
    for progress in list(_logs):
        progress.part()


if hasattr(os, "register_at_fork"):
    # What is forked may be a loader worker, and must find the log of the process that it works for.
    os.register_at_fork(before=_part_before_fork)
