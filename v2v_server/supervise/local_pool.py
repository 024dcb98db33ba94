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
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import psutil

from v2v_protocol.errors import WorkerCrashLoop
from v2v_protocol.programs import environment
from v2v_server.broker.blame import Cause, Loss
from v2v_server.supervise.protocol import Death
from v2v_server.worker.logbook import Logbook

_FIRST_BACKOFF_SECONDS = 0.2
_LONGEST_BACKOFF_SECONDS = 10.0
_MEMORY_SECONDS = 5.0
"""After the kernel has killed for want of memory, a worker's SIGKILL is taken for its doing: to end takes a moment."""
_LOOK_SECONDS = 1.0
"""From one look at whether workers are stopped to the next."""
_SHORTAGES = (errno.EAGAIN, errno.ENOMEM, errno.EMFILE, errno.ENFILE)
_AFTER_SHORTAGE_SECONDS = 5.0
_CRASH_SIGNALS = (signal.SIGSEGV, signal.SIGBUS, signal.SIGABRT, signal.SIGILL, signal.SIGFPE)
_STOPPED = (psutil.STATUS_STOPPED, psutil.STATUS_TRACING_STOP)
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")


@dataclass(slots=True, eq=False)
class _Post:
    number: int
    process: subprocess.Popen[bytes] | None = None
    logbook: Logbook | None = None
    identity: bytes = b""
    generation: int = 0
    given_up: bool = False
    start_at: float = 0.0

    def close(self) -> None:
        """Forgets the process, which has ended."""
        self.process = None
        if self.logbook is not None:
            self.logbook.close()
            self.logbook = None


class Pool:
    """Keeps a number of worker processes running: a :class:`v2v_server.supervise.protocol.Supervisor`.

    Args:
        root: the corpus folder.
        label: prefix of the workers' names, unique to this server.
        flags: more of them for each worker.
    """

    def __init__(self, root: Path, label: str, flags: Sequence[str] = ()) -> None:
        self._flags = flags
        self._posts: list[_Post] = []
        self._leaving: list[_Post] = []  # too many: told to leave
        self._numbered = 0
        self._root = root
        self._address = ""
        self._label = label
        self._deaths_in_a_row = 0
        self._samples_seen = 0
        self._memory_kills = _out_of_memory_kills()
        self._short_of_memory_until = -math.inf
        self._looked = -math.inf

    @property
    def crash_budget(self) -> int:
        """Deaths in a row, without any finished sample between them, that are survived."""
        return 3 * len(self._posts) + 4

    @property
    def running(self) -> int:
        """Processes that are alive."""
        return len(self.pids())

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
        if samples > self._samples_seen:
            self._samples_seen = samples
            self._deaths_in_a_row = 0
        deaths = []
        ended = {post.number for post in self._all() if post.process and post.process.poll() is not None}
        memory_kills = _out_of_memory_kills()  # counted before its victims are gone, so these are in it
        if memory_kills > self._memory_kills:
            self._memory_kills, self._short_of_memory_until = memory_kills, now + _MEMORY_SECONDS
        for post in self._all():
            if post.process is None or post.number not in ended:
                continue
            at = None if post.logbook is None else post.logbook.lease()
            loss = _post_mortem(post.process.returncode, short_of_memory=now < self._short_of_memory_until)
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

    def stopped(self, now: float) -> dict[bytes, float]:
        """Workers that are stopped from outside, and for how many seconds since the last call."""
        since, self._looked = now - self._looked, now if now - self._looked >= _LOOK_SECONDS else self._looked
        if since < _LOOK_SECONDS:
            return {}
        processes = {post.identity: post.process for post in self._all() if post.process is not None}
        stopped = [name for name, process in processes.items() if _is_stopped(process.pid)]
        return dict.fromkeys(stopped, min(since, 2 * _LOOK_SECONDS))

    def _put_off(self, post: _Post, death: Death, now: float) -> None:
        """Lets some time pass before the next process of a post.

        Raises:
            WorkerCrashLoop: the crash budget is used up.
        """
        self._deaths_in_a_row += 1
        if self._deaths_in_a_row > self.crash_budget:
            raise WorkerCrashLoop(
                f"{self._deaths_in_a_row} server workers died in a row without finishing a sample (limit "
                f"{self.crash_budget}); the last one {death.loss.text}. What they printed is above; "
                f"`v2v-simulate` on one of the videos shows the same in one process"
            )
        # Capped before the power: hundreds of deaths in a row, as many workers allow, would overflow a float.
        doublings = min(self._deaths_in_a_row - 1, 16)
        delay = min(_FIRST_BACKOFF_SECONDS * 2**doublings, _LONGEST_BACKOFF_SECONDS)
        post.process, post.start_at = None, now + delay

    def give_up(self, identity: bytes, reason: str) -> Loss | None:
        """Kills a worker that hangs.

        Returns:
            what its loss means, not to be reported again by :meth:`watch`; None when it is none of this pool's.
        """
        for post in self._all():
            if post.identity == identity and post.process is not None:
                post.given_up = True
                status = _status(post.process.pid)
                post.process.kill()
                if status in _STOPPED:
                    return Loss(Cause.KILLED, "was stopped from outside and killed")
                at = None if post.logbook is None else post.logbook.lease()
                decodes = post.logbook is not None and post.logbook.decodes()
                if status == psutil.STATUS_DISK_SLEEP:
                    # A network file system whose server is away holds every worker at whatever clip it has.
                    return Loss(Cause.UNEXPLAINED, f"waited for its storage and {reason}", at, decodes)
                return Loss(Cause.HUNG, reason, at, decodes)
        return None

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
        post.given_up = False
        name = f"{self._label}-{post.number}.{post.generation}"
        post.identity = name.encode()
        post.close()
        post.logbook = Logbook()
        post.process = subprocess.Popen(
            [*_command(self._address, self._root, name), *self._flags, "--logbook-fd", str(post.logbook.descriptor)],
            stdin=subprocess.DEVNULL,
            pass_fds=(post.logbook.descriptor,),
            env=environment() | _ONE_THREAD,
            process_group=0,
        )


def _command(address: str, root: Path, name: str) -> list[str]:
    """The program of one worker."""
    return [
        *(sys.executable, "-m", "v2v_server.commands.worker"),
        *("--connect", address, "--videos", str(root), "--name", name),
        *("--parent-pid", str(os.getpid())),
    ]


def _post_mortem(returncode: int, *, short_of_memory: bool) -> Loss:
    """What the end of a worker means that was not asked for."""
    if returncode >= 0:
        # An exception nobody foresaw, a broken installation: the trace is on stderr, whose fault it is is not.
        return Loss(Cause.UNEXPLAINED, f"exited with status {returncode}")
    number = -returncode
    name = signal.Signals(number).name if number in set(signal.Signals) else f"signal {number}"
    if number in _CRASH_SIGNALS:
        return Loss(Cause.CRASHED, f"was ended by {name}")
    if number == signal.SIGKILL and short_of_memory:
        return Loss(Cause.UNEXPLAINED, f"was ended by {name} while the host ran out of memory")
    if number in (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        return Loss(Cause.KILLED, f"was ended by {name} from outside")
    return Loss(Cause.UNEXPLAINED, f"was ended by {name}")


def _is_stopped(pid: int) -> bool:
    """By its own words, which are cheap to ask a thousand workers for."""
    try:
        state = Path(f"/proc/{pid}/stat").read_bytes().rpartition(b") ")[2][:1]
    except OSError:
        return sys.platform != "linux" and _status(pid) in _STOPPED
    return state in (b"T", b"t")


def _status(pid: int) -> str:
    """What a process is at, in psutil's words: stopped, also by a debugger, or in the kernel, waiting for a disk ..."""
    try:
        return str(psutil.Process(pid).status())
    except psutil.NoSuchProcess:
        return psutil.STATUS_DEAD


def _out_of_memory_kills() -> int:
    """How many processes the kernel of this host has killed for want of memory; 0 where it does not say."""
    try:
        for line in Path("/proc/vmstat").read_text(encoding="ascii").splitlines():
            if line.startswith("oom_kill "):
                return int(line.split()[1])
    except OSError:
        pass
    return 0


def _wait(processes: Sequence[subprocess.Popen[bytes]], seconds: float) -> None:
    deadline = time.monotonic() + seconds
    for process in processes:
        try:
            process.wait(max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            return
