"""The pool with harmless programs in the place of workers, some of them started before there is work."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from typing import Any

import psutil
import pytest

from tests.waiting import until
from v2v_protocol.errors import CorpusError, WorkerCrashLoop
from v2v_server.broker.leases import Cause, Loss
from v2v_server.config import ServeConfig
from v2v_server.supervise import local_host
from v2v_server.supervise.local_host import LocalHost, WorkerProcess, start_ahead
from v2v_server.supervise.pool import Death, Pool, crash_budget
from v2v_server.worker.logbook import note

SLEEPS = "import time\ntime.sleep(600)"
NAPS = "import time\nwhile True:\n    time.sleep(0.01)"
"""For programs with a handler in Python: a signal just before a long sleep would be handled after it."""


@pytest.fixture(autouse=True)
def _hangups_and_interrupts_count() -> Iterator[None]:
    """Under ``nohup``, or in the background of a script, they are ignored, and children inherit that."""
    before = {number: signal.signal(number, signal.SIG_DFL) for number in (signal.SIGHUP, signal.SIGINT)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[int, str], Pool]]:
    """Makes a pool of programs given as Python text; all are gone at the end."""
    pools: list[Pool] = []

    def make(workers: int, program: str) -> Pool:
        monkeypatch.setattr(local_host, "PROGRAM", (sys.executable, "-S", "-E", "-c", program))
        pools.append(Pool(LocalHost("/corpus"), "label"))
        pools[-1].start("tcp://127.0.0.1:1")
        pools[-1].scale(workers)
        return pools[-1]

    yield make
    for each in pools:
        each.stop(join_seconds=0.0, terminate_seconds=0.0)


def pids_of(pool: Pool) -> list[int]:
    """Process ids of the workers that are alive."""
    return [slot.place.child.process.pid for slot in pool._slots if slot.place.is_running]


def started(pool: Pool) -> Pool:
    pool.watch(0.0, 0)
    return pool


def all_dead(pool: Pool) -> None:
    until(lambda: pool.running == 0)


def deaths_at(pool: Pool, now: float) -> list[Death]:
    """Start workers that end by themselves, perhaps before this call of ``watch`` returns; return their deaths."""
    deaths = pool.watch(now, 0)
    all_dead(pool)
    return deaths + pool.watch(now, 0)


def is_loaded(pid: int) -> bool:
    """Whether the process runs its program: before that it still has the signal handlers of the one it came from."""
    return b"label-" in Path(f"/proc/{pid}/cmdline").read_bytes()


def is_gone(pid: int) -> bool:
    """Neither running nor a zombie."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


# --- starting and watching --------------------------------------------------------------------------------------------


def test_a_host_says_which_workers_go_on(start: Callable[[int, str], Pool]) -> None:
    made = started(start(2, SLEEPS))
    ended, going = (slot.place for slot in made._slots)
    ended.child.process.kill()
    ended.child.process.wait()
    assert made._host.wait([ended, going], 0.0) == [going]


def test_it_starts_as_many_as_asked_each_with_a_name_of_its_own(start: Callable[[int, str], Pool]) -> None:
    pool = start(2, SLEEPS)
    assert (pool.running, pids_of(pool)) == (0, [])
    assert pool.watch(0.0, 0) == []
    assert pool.running == 2
    pids = pids_of(pool)
    assert all(os.getpgid(pid) == pid != os.getpgid(0) for pid in pids)

    def names() -> list[bytes]:
        # Four arguments follow; a process has none to show until its program has been loaded.
        return [(b"\0" * 5 + Path(f"/proc/{pid}/cmdline").read_bytes()).split(b"\0")[-6] for pid in pids]

    until(lambda: b"" not in names())
    assert names() == [b"label-0.1", b"label-1.1"]
    assert pool.watch(100.0, 0) == []
    assert pids_of(pool) == pids


def test_one_that_dies_while_it_leaves_is_reported_and_not_replaced(start: Callable[[int, str], Pool]) -> None:
    pool = start(1, "import os, signal, time\nsignal.signal(15, lambda *_: os.kill(os.getpid(), 11))\n" + NAPS)
    pool.watch(0.0, 0)
    until(lambda: is_loaded(pids_of(pool)[0]) and _catches_terminate(pids_of(pool)[0]))
    pool.scale(0)
    all_dead(pool)
    assert pool.watch(1.0, 0) == [Death(b"label-0.1", Loss(Cause.CRASHED, "was ended by SIGSEGV"))]
    assert pool.watch(100.0, 0) == []
    assert pool.running == 0


def _catches_terminate(pid: int) -> bool:
    (caught,) = (
        line.split()[1]
        for line in Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines()
        if line.startswith("SigCgt")
    )
    return bool(int(caught, 16) >> (signal.SIGTERM - 1) & 1)


def test_a_process_that_the_system_does_not_start_is_tried_again(
    start: Callable[[int, str], Pool], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It has no memory, process or file left for it; those that run go on."""
    pool = start(2, SLEEPS)
    short = [False]
    popen = subprocess.Popen

    def spawn(*arguments: Any, **options: Any) -> subprocess.Popen[bytes]:
        if short[0]:
            raise BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")
        return popen(*arguments, **options)

    monkeypatch.setattr(subprocess, "Popen", spawn)
    assert pool.watch(0.0, 0) == []
    os.kill(pids_of(pool)[0], signal.SIGKILL)
    until(lambda: pool.running == 1)
    short[0] = True
    assert [death.identity for death in pool.watch(1.0, 0)] == [b"label-0.1"]
    lost = Death(b"label-0.2", Loss(Cause.KILLED, "could not be started: Resource temporarily unavailable"))
    assert pool.watch(2.0, 0) == [lost]
    assert not pool.watches(b"label-0.2")
    for turn in range(1, crash_budget(2) + 2):  # however often: no worker has crashed
        assert len(pool.watch(2.0 + 10.0 * turn, 0)) == 1
    short[0] = False
    assert pool.watch(1e3, 0) == []
    assert pool.running == 2


def test_a_system_that_starts_no_process_at_all_ends_in_the_crash_budget(
    start: Callable[[int, str], Pool], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any, **options: Any) -> subprocess.Popen[bytes]:
        raise FileNotFoundError(errno.ENOENT, "No such file or directory", "/gone/python")

    monkeypatch.setattr(subprocess, "Popen", refuse)
    pool = start(1, SLEEPS)
    for now in range(crash_budget(1)):
        assert len(pool.watch(100.0 * now, 0)) == 1
    with pytest.raises(WorkerCrashLoop, match="could not be started: No such file or directory"):
        pool.watch(1e6, 0)


@pytest.mark.parametrize(
    ("number", "cause", "text"),
    [
        (signal.SIGKILL, Cause.KILLED, "was ended by SIGKILL from outside"),
        (signal.SIGTERM, Cause.KILLED, "was ended by SIGTERM from outside"),
        (signal.SIGINT, Cause.KILLED, "was ended by SIGINT from outside"),
        (signal.SIGHUP, Cause.KILLED, "was ended by SIGHUP from outside"),
        (signal.SIGSEGV, Cause.CRASHED, "was ended by SIGSEGV"),
        (signal.SIGBUS, Cause.CRASHED, "was ended by SIGBUS"),
        (signal.SIGABRT, Cause.CRASHED, "was ended by SIGABRT"),
        (signal.SIGFPE, Cause.CRASHED, "was ended by SIGFPE"),
        (signal.SIGILL, Cause.CRASHED, "was ended by SIGILL"),
        (signal.SIGALRM, Cause.UNEXPLAINED, "was ended by SIGALRM"),
        (signal.SIGRTMIN + 3, Cause.UNEXPLAINED, f"was ended by signal {signal.SIGRTMIN + 3}"),
    ],
)
def test_a_crash_is_told_from_a_kill(
    start: Callable[[int, str], Pool], monkeypatch: pytest.MonkeyPatch, number: int, cause: Cause, text: str
) -> None:
    monkeypatch.setattr(local_host, "out_of_memory_kills", lambda: 5)
    pool = started(start(1, SLEEPS))
    until(lambda: is_loaded(pids_of(pool)[0]))
    os.kill(pids_of(pool)[0], number)
    all_dead(pool)
    assert pool.watch(1.0, 0) == [Death(b"label-0.1", Loss(cause, text))]


def test_all_that_are_killed_at_once_for_want_of_memory_are_told_so_and_none_long_after(
    start: Callable[[int, str], Pool], monkeypatch: pytest.MonkeyPatch
) -> None:
    kills = [7]
    monkeypatch.setattr(local_host, "out_of_memory_kills", lambda: kills[0])
    pool = start(2, SLEEPS)

    def causes_of_deaths_at(now: float) -> list[Cause]:
        for pid in pids_of(pool):
            os.kill(pid, signal.SIGKILL)
        all_dead(pool)
        return [death.loss.cause for death in pool.watch(now, 1)]

    pool.watch(0.0, 0)
    kills[0] += 2
    assert causes_of_deaths_at(10.0) == [Cause.MEMORY] * 2
    pool.watch(20.0, 1)
    kills[0] += 1
    pool.watch(30.0, 1)  # what was killed takes a moment to be gone
    assert causes_of_deaths_at(30.1) == [Cause.MEMORY] * 2
    pool.watch(40.0, 1)
    kills[0] += 1  # something else on this host
    pool.watch(50.0, 1)
    assert causes_of_deaths_at(1000.0) == [Cause.KILLED] * 2


@pytest.mark.parametrize("status", [0, 1, 3])
def test_an_exit_is_not_blamed_on_the_sample(start: Callable[[int, str], Pool], status: int) -> None:
    pool = start(1, f"import sys\nsys.exit({status})")
    assert deaths_at(pool, 0.0) == [Death(b"label-0.1", Loss(Cause.UNEXPLAINED, f"exited with status {status}"))]


def test_a_worker_that_somebody_stopped_is_not_called_hung(start: Callable[[int, str], Pool]) -> None:
    pool = started(start(1, SLEEPS))
    (pid,) = pids_of(pool)
    os.kill(pid, signal.SIGSTOP)
    until(lambda: psutil.Process(pid).status() == psutil.STATUS_STOPPED)
    loss = pool.give_up(b"label-0.1", "slept")
    assert loss is not None
    assert loss.cause is Cause.KILLED
    all_dead(pool)


def test_it_says_how_long_a_worker_was_stopped_from_outside(start: Callable[[int, str], Pool]) -> None:
    """It may go on just before its deadline, and look like any other then."""
    pool = started(start(2, SLEEPS))
    pid, _ = pids_of(pool)

    def stopped(now: float) -> dict[bytes, float]:
        seconds = {name: stalled.stopped_seconds for name, stalled in pool.stalled(now).items()}
        return {name: each for name, each in seconds.items() if each}

    assert stopped(0.0) == {}
    os.kill(pid, signal.SIGSTOP)
    until(lambda: psutil.Process(pid).status() == psutil.STATUS_STOPPED)
    assert stopped(0.5) == {}  # it looks once a second
    assert stopped(1.5) == {b"label-0.1": 1.5}
    assert stopped(2.5) == {b"label-0.1": 1.0}
    os.kill(pid, signal.SIGCONT)
    until(lambda: psutil.Process(pid).status() != psutil.STATUS_STOPPED)
    assert stopped(5.0) == {}


def test_it_says_how_long_a_worker_waited_for_a_core(start: Callable[[int, str], Pool]) -> None:
    """Many that want the one core that they may use."""
    pool = started(start(4, "while True: pass"))
    core = min(os.sched_getaffinity(0))
    for pid in pids_of(pool):
        os.sched_setaffinity(pid, {core})
    looks = count(1.0)  # a second between one look and the next, as it goes by the clock that it is told

    def all_waited() -> bool:
        found = pool.stalled(next(looks)).values()
        return len(found) == 4 and all(0 < each.queued_seconds <= 1 and not each.stopped_seconds for each in found)

    until(all_waited)


# --- stopping ---------------------------------------------------------------------------------------------------------


def test_stop_reaps_what_ignores_every_request(start: Callable[[int, str], Pool], tmp_path: Path) -> None:
    stubborn = (
        "import signal, sys, time\n"
        "for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):\n"
        "    signal.signal(number, signal.SIG_IGN)\n"
        f"open({str(tmp_path)!r} + '/' + sys.argv[8], 'w').close()\n"
        "time.sleep(600)\n"
    )
    pool = started(start(2, stubborn))
    pids = pids_of(pool)
    until(lambda: len(list(tmp_path.iterdir())) == 2)
    pool.stop(join_seconds=0.0, terminate_seconds=0.1)
    assert pool.running == 0
    assert all(is_gone(pid) for pid in pids)


def test_stop_after_a_crash_leaves_no_zombie_and_may_come_twice(start: Callable[[int, str], Pool]) -> None:
    pool = started(start(2, SLEEPS))
    pids = pids_of(pool)
    os.kill(pids[0], signal.SIGKILL)
    pool.stop(join_seconds=0.0)
    pool.stop()
    assert all(is_gone(pid) for pid in pids)


@pytest.mark.parametrize("decodes", [True, False])
def test_only_a_death_while_decoding_speaks_against_the_video(decodes: bool) -> None:
    child = WorkerProcess()
    with open(f"/proc/self/fd/{child.logbook.descriptor}", "r+b") as worker:
        note(worker.fileno(), 7, decodes=decodes)
    seen = child.status()
    assert (seen.lease, seen.decodes) == (7, decodes)
    child.process.send_signal(signal.SIGSEGV)
    child.process.wait()
    assert child.post_mortem(short_of_memory=False) == Loss(Cause.CRASHED, "was ended by SIGSEGV", 7, for_all=decodes)
    child.end()


# --- workers that are started before there is work --------------------------------------------------------------------


WRITES = "import os, sys; open(sys.argv[1], 'wb').write(sys.stdin.buffer.read())"


@pytest.fixture
def told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The file in which a standby writes what it is told; it ends then."""
    path = tmp_path / "told"
    monkeypatch.setattr(local_host, "PROGRAM", (sys.executable, "-S", "-E", "-c", WRITES, str(path)))
    return path


def test_the_pool_takes_standbys_first_and_tells_them_the_arguments_of_a_worker(told: Path) -> None:
    config = ServeConfig(videos="/corpus", workers=(1, 1))
    with start_ahead(config) as standbys:
        (standby,) = standbys
        expected = local_host.arguments("tcp://127.0.0.1:1", "/corpus", "label-0.1", ["--debug"], standby.logbook)
        pool = Pool(LocalHost("/corpus", ["--debug"], standbys), "label")
        pool.start("tcp://127.0.0.1:1")
        pool.scale(1)
        pool.watch(0.0, 0)
        assert standbys == []
        standby.process.wait()
        pool.stop(0.0, 0.0)
    assert told.read_bytes().decode().split("\0") == expected


def test_standbys_that_are_not_used_end_with_the_start(told: Path) -> None:
    def fail(config: ServeConfig, started: list[WorkerProcess]) -> None:
        with start_ahead(config) as standbys:
            started += standbys
            raise CorpusError("no videos")

    started: list[WorkerProcess] = []
    with pytest.raises(CorpusError):
        fail(ServeConfig(videos="videos", workers=(2, 2)), started)
    assert len(started) == 2
    assert all(each.process.returncode is not None for each in started)


def test_a_standby_that_has_ended_is_a_failed_start_and_leaves_no_zombie(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local_host, "PROGRAM", (sys.executable, "-S", "-E", "-c", "raise SystemExit(3)"))
    standby = WorkerProcess()
    standby.process.wait()
    pool = Pool(LocalHost("/corpus", (), [standby]), "label")
    pool.start("tcp://127.0.0.1:1")
    pool.scale(1)
    (death,) = pool.watch(0.0, 0)
    assert "could not be started" in death.loss.text
    pool.stop(0.0, 0.0)


def test_a_server_with_workers_elsewhere_starts_none() -> None:
    config = ServeConfig(videos="videos", engine="ray", worker_bind="tcp://127.0.0.1:5556")
    with start_ahead(config) as standbys:
        assert standbys == []
