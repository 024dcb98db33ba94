"""The pool of local worker processes: spawn, watch, restart with backoff, stop. Who spawns also reaps.

Workers are started as programs of their own (never forked), in their own process group so that Ctrl-C in a terminal
reaches only the server, and die with the server even when it is killed.

A worker that dies is started again after a delay that doubles with every death in a row. When the workers die again and
again without a single sample being finished, something is wrong that restarting does not mend, and the pool says so.
"""

from __future__ import annotations

import errno
import math
import os
import signal
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

from v2v_server.broker.blame import Cause, Loss
from v2v_server.broker.leases import Stall
from v2v_server.supervise.child import (
    hung,
    is_stopped,
    out_of_memory_kills,
    post_mortem,
    queued_seconds,
    start_child,
    status_of,
)
from v2v_server.supervise.protocol import Death
from v2v_server.supervise.restarts import Restarts, crash_budget
from v2v_server.worker.logbook import Logbook

_MEMORY_SECONDS = 5.0
"""After the kernel has killed for want of memory, a worker's SIGKILL is taken for its doing: to end takes a moment."""
_LOOK_SECONDS = 1.0
"""From one look at whether workers are kept from working to the next."""
_SHORTAGES = (errno.EAGAIN, errno.ENOMEM, errno.EMFILE, errno.ENFILE)
_AFTER_SHORTAGE_SECONDS = 5.0


@dataclass(slots=True, eq=False)
class _Post:
    number: int
    process: subprocess.Popen[bytes] | None = None
    logbook: Logbook | None = None
    identity: bytes = b""
    generation: int = 0
    given_up: bool = False
    start_at: float = 0.0
    queued_seconds: float = 0.0  # that its process had waited for a core at the last look

    def close(self) -> None:
        """Forgets the process, which has ended."""
        self.process = None
        if self.logbook is not None:
            self.logbook.close()
            self.logbook = None


class Pool:
    """Keeps a number of worker processes running: a :class:`v2v_server.supervise.protocol.Supervisor`.

    Args:
        root: the corpus, a folder or an address.
        label: prefix of the workers' names, unique to this server.
        flags: more of them for each worker.
    """

    def __init__(self, root: str | os.PathLike[str], label: str, flags: Sequence[str] = ()) -> None:
        self._flags = flags
        self._posts: list[_Post] = []
        self._leaving: list[_Post] = []  # too many: told to leave
        self._numbered = 0
        self._root = os.fspath(root)
        self._address = ""
        self._label = label
        self._restarts = Restarts()
        self._memory_kills = out_of_memory_kills()
        self._short_of_memory_until = -math.inf
        self._looked = -math.inf

    @property
    def crash_budget(self) -> int:
        """Deaths in a row, without any finished sample between them, that are survived."""
        return crash_budget(len(self._posts))

    @property
    def running(self) -> int:
        """Processes that are alive."""
        return len(self.pids())

    @property
    def restarts(self) -> dict[bytes, int]:
        """How often the place of each worker was filled before."""
        return {post.identity: post.generation - 1 for post in self._all() if post.process is not None}

    def start(self, address: str) -> None:
        """Workers that :meth:`watch` starts connect to ``address``."""
        self._address = address

    def scale(self, workers: int) -> None:
        """There shall be so many; :meth:`watch` starts those that lack."""
        while len(self._posts) < workers:
            self._posts.append(_Post(self._numbered))
            self._numbered += 1
        self._posts, surplus = self._posts[:workers], self._posts[workers:]
        for post in surplus:
            if post.process is not None:
                post.process.terminate()  # it finishes the sample it is at, gives back the others and leaves
                self._leaving.append(post)

    def pids(self) -> list[int]:
        """Process ids of the workers that are alive."""
        processes = [post.process for post in self._all() if post.process is not None]
        return [process.pid for process in processes if process.poll() is None]

    def watches(self, identity: bytes) -> bool:
        """Whether :meth:`watch` will report how that worker ends: one of this pool's that was not given up."""
        return any(post.identity == identity and post.process and not post.given_up for post in self._all())

    def watch(self, now: float, samples: int) -> list[Death]:
        """Reaps the dead and starts what is due. To be called a few times a second.

        Args:
            now: the time, seconds.
            samples: samples finished so far by all workers; any progress forgives earlier deaths.

        Raises:
            WorkerCrashLoop: the crash budget is used up.
        """
        self._restarts.progress(samples)
        deaths = []
        ended = {post.number for post in self._all() if post.process and post.process.poll() is not None}
        memory_kills = out_of_memory_kills()  # counted before its victims are gone, so these are in it
        if memory_kills > self._memory_kills:
            self._memory_kills, self._short_of_memory_until = memory_kills, now + _MEMORY_SECONDS
        for post in self._all():
            if post.process is None or post.number not in ended:
                continue
            at = None if post.logbook is None else post.logbook.lease()
            loss = post_mortem(post.process.returncode, short_of_memory=now < self._short_of_memory_until)
            death = Death(post.identity, replace(loss, lease=at))
            as_told = post in self._leaving and post.process.returncode in (0, -signal.SIGTERM)
            if post in self._leaving:
                self._leaving.remove(post)
                post.close()
            else:
                self._put_off(post, death, now)
            if not post.given_up and not as_told:
                deaths.append(death)
        for post in self._posts:
            if post.process is None and now >= post.start_at:
                try:
                    self._start(post)
                except OSError as error:
                    # Too many processes or files, no memory for one more: that passes, must not end those that run, and
                    # says nothing of workers.
                    text = f"could not be started: {error.strerror or error}"
                    deaths.append(Death(post.identity, Loss(Cause.KILLED, text)))
                    if error.errno in _SHORTAGES:
                        post.process, post.start_at = None, now + _AFTER_SHORTAGE_SECONDS
                    else:
                        self._put_off(post, deaths[-1], now)
        return deaths

    def stalled(self, now: float) -> dict[bytes, Stall]:
        """Workers that were kept from working since the last call, and how long."""
        since = now - self._looked
        if since < _LOOK_SECONDS:
            return {}
        self._looked = now
        found = {}
        for post in self._all():
            if post.process is None:
                continue
            before, post.queued_seconds = post.queued_seconds, queued_seconds(post.process.pid)
            stopped = min(since, 2 * _LOOK_SECONDS) if is_stopped(post.process.pid) else 0.0
            queued = min(since - stopped, post.queued_seconds - before)
            if stopped or queued > 0:
                found[post.identity] = Stall(stopped, max(queued, 0.0))
        return found

    def _put_off(self, post: _Post, death: Death, now: float) -> None:
        """Lets some time pass before the next process of a post.

        Raises:
            WorkerCrashLoop: the crash budget is used up.
        """
        post.process, post.start_at = None, now + self._restarts.delay(len(self._posts), death.loss)

    def give_up(self, identity: bytes, reason: str) -> Loss | None:
        """Kills a worker that hangs.

        Returns:
            what its loss means, not to be reported again by :meth:`watch`; None when it is none of this pool's.
        """
        for post in self._all():
            if post.identity == identity and post.process is not None:
                post.given_up = True
                status = status_of(post.process.pid)
                post.process.kill()
                at = None if post.logbook is None else post.logbook.lease()
                return hung(status, reason, at, decodes=post.logbook is not None and post.logbook.decodes())
        return None

    def news(self) -> list[str]:
        """None: all of them are on this host."""
        return []

    def stop(self, join_seconds: float = 5.0, terminate_seconds: float = 2.0) -> None:
        """Ends every worker: waits for those that were told to stop, then terminates, then kills. All are reaped."""
        processes = [post.process for post in self._all() if post.process is not None]
        _wait(processes, join_seconds)
        for process in processes:
            if process.poll() is None:
                process.terminate()
        _wait(processes, terminate_seconds)
        for process in processes:
            if process.poll() is None:
                process.kill()
            process.wait()
        for post in self._all():
            post.close()
        self._posts, self._leaving = [], []

    def _all(self) -> list[_Post]:
        return [*self._posts, *self._leaving]

    def _start(self, post: _Post) -> None:
        post.generation += 1
        post.given_up, post.queued_seconds = False, 0.0
        name = f"{self._label}-{post.number}.{post.generation}"
        post.identity = name.encode()
        post.close()
        post.logbook = Logbook()
        post.process = start_child(self._address, self._root, name, self._flags, post.logbook)


def _wait(processes: Sequence[subprocess.Popen[bytes]], seconds: float) -> None:
    deadline = time.monotonic() + seconds
    for process in processes:
        try:
            process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            return
