"""Jobs in processes of their own: crashes cost one job, and nothing is left running.

What the processes import is this module, so it imports little.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import pickle
import signal
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

import msgpack
import psutil
import pytest

from v2v_protocol.errors import UsageError
from v2v_server.system.isolate import LARGEST_MESSAGE_BYTES, Died, run_isolated


@pytest.fixture(autouse=True)
def _no_process_left() -> Iterator[None]:
    yield
    assert not psutil.wait_procs(children(), timeout=60)[1]


def children() -> list[psutil.Process]:
    """Processes below this one, but for the tracker that multiprocessing keeps as long as its own process lives."""
    below = psutil.Process().children(recursive=True)
    return [process for process in below if "resource_tracker" not in " ".join(process.cmdline())]


LED_ITS_SESSION_AT_IMPORT = os.getsid(0) == os.getpid()


def square_or_die(number: int) -> int:
    if number == 3:
        os.kill(os.getpid(), signal.SIGSEGV)
    if number == 5:
        os._exit(7)
    return number * number


def test_a_crash_costs_one_job() -> None:
    results = dict(run_isolated(square_or_die, range(9), processes=2))
    assert results.pop(3) == Died(-signal.SIGSEGV)
    assert results.pop(5) == Died(7)
    assert results == {n: n * n for n in (0, 1, 2, 4, 6, 7, 8)}
    assert dict(run_isolated(square_or_die, [1, 2], processes=0)) == {1: 1, 2: 4}
    assert dict(run_isolated(square_or_die, [], processes=2)) == {}


def square_or_wait(job: tuple[int, str]) -> int:
    """Waits for somebody to write into the named pipe."""
    number, pipe = job
    if pipe:
        Path(pipe).read_bytes()
    return number * number


def test_a_job_that_never_ends_costs_only_itself(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    jobs = [(1, ""), (2, str(tmp_path / "pipe")), (3, ""), (4, "")]
    allowed = {job: 1.0 if job[1] else 60.0 for job in jobs}
    results = {job[0]: result for job, result in run_isolated(square_or_wait, jobs, 1, allowed.__getitem__)}
    hung = results.pop(2)
    assert hung == Died(-signal.SIGKILL, 1.0)
    assert isinstance(hung, Died)
    assert (hung.how, hung.is_crash) == ("ended after 1 s without a result", False)
    assert results == {1: 1, 3: 9, 4: 16}


def room_for(size_bytes: int) -> bool:
    try:
        return len(bytearray(size_bytes)) == size_bytes
    except MemoryError:
        return False


def test_a_process_gets_no_more_memory_than_it_may_have() -> None:
    results = dict(run_isolated(room_for, [1 << 20, 1 << 29], 1, memory_bytes=256 << 20))
    assert results == {1 << 20: True, 1 << 29: False}


def test_leaving_early_ends_the_processes() -> None:
    results = run_isolated(square_or_die, range(3), processes=2)
    next(results)
    results.close()  # type: ignore[attr-defined]
    assert not children()


def test_how_a_process_died() -> None:
    deaths = [Died(7), Died(-signal.SIGSEGV), Died(-signal.SIGKILL), Died(-signal.SIGTERM), Died(-40)]
    assert [death.how for death in deaths] == [
        "exit status 7", "signal SIGSEGV", "signal SIGKILL", "signal SIGTERM", "signal 40",
    ]  # fmt: skip
    assert [death.is_crash for death in deaths] == [False, True, False, False, True]
    assert not Died(-signal.SIGSEGV, begun=False).is_crash
    assert not Died(-signal.SIGSEGV, overdue_seconds=1.0).is_crash


class Evil:
    """What unpickling it does."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.mkdir, (os.environ.get("V2V_TEST_STRUCK", ""),)


ATTACKS = {
    "an object": pickle.dumps(Evil()),
    "a framed object": len(pickle.dumps(Evil())).to_bytes(4, "big") + pickle.dumps(Evil()),
    "too many bytes": b"",  # made when it is sent
    "text": msgpack.packb("9"),
    "two results": msgpack.packb(9) * 2,
}


def square_or_attack(job: tuple[int, str]) -> int:
    """Do what a video can make a process do that it has taken over: write anything to the socket."""
    number, attack = job
    if attack:
        (connection,) = (each for each in gc.get_objects() if isinstance(each, socket.socket))
        with contextlib.suppress(OSError):
            connection.sendall(ATTACKS.get(attack, b"\xc4"))
            if attack == "too many bytes":
                connection.sendall(b"\xc6" + LARGEST_MESSAGE_BYTES.to_bytes(4, "big") + bytes(LARGEST_MESSAGE_BYTES))
            if attack == "no end":
                os.close(connection.detach())
        while True:
            signal.pause()
    return number * number


def test_a_hostile_result_costs_one_job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("V2V_TEST_STRUCK", str(tmp_path / "struck"))
    jobs = [each for number, attack in enumerate(ATTACKS) for each in ((number, attack), (number, ""))]
    results = dict(run_isolated(square_or_attack, jobs, 2, lambda job: 60.0))
    assert not (tmp_path / "struck").exists()
    for number, attack in enumerate(ATTACKS):
        death = results[number, attack]
        assert isinstance(death, Died), attack
        assert (death.is_crash, death.how) == (True, "it sent a malformed result"), attack
        assert results[number, ""] == number * number


def test_half_a_result_costs_one_job() -> None:
    jobs = [(1, ""), (2, "half a result"), (3, ""), (4, "no end"), (5, "")]
    results = dict(run_isolated(square_or_attack, jobs, 1, lambda job: 3.0 if job[0] == 2 else 60.0))
    assert results[2, "half a result"] == Died(-signal.SIGKILL, 3.0)
    assert results[4, "no end"] == Died(-signal.SIGKILL)
    assert [results[number, ""] for number in (1, 3, 5)] == [1, 9, 25]


def test_a_process_has_nothing_of_its_parent_but_the_connection_and_its_output() -> None:
    with open(os.devnull) as file:
        os.set_inheritable(file.fileno(), True)
        assert dict(run_isolated(kinds_of_descriptors, [None], processes=1)) == {None: ("/dev/null", *["socket"] * 3)}


def kinds_of_descriptors(job: None) -> tuple[str, ...]:
    """Return what this process has open."""
    names = [os.readlink(f"/proc/self/fd/{each}") for each in range(64) if is_open(each)]
    return tuple(name.partition(":")[0] for name in names)


def is_open(descriptor: int) -> bool:
    with contextlib.suppress(OSError):
        os.fstat(descriptor)
        return True
    return False


def led_its_session(job: None) -> bool:
    """Whether no Ctrl-C could have struck this process while it started."""
    return LED_ITS_SESSION_AT_IMPORT


def test_an_interrupt_strikes_the_caller_only() -> None:
    assert list(run_isolated(led_its_session, [None, None, None], processes=2)) == [(None, True)] * 3


def test_a_process_that_cannot_be_started(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: object, **options: object) -> None:
        raise BlockingIOError("Resource temporarily unavailable")

    monkeypatch.setattr("v2v_server.system.isolate.subprocess.Popen", refuse)
    with pytest.raises(BlockingIOError):
        list(run_isolated(square_or_die, [1], processes=1))


def test_a_process_that_ends_during_its_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(UsageError, match=r"ended during its start \(exit status 1\)"):
        list(run_isolated(square_or_die, [1], processes=1))


def test_modules_are_found_where_the_caller_finds_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where only the script itself says so, and not where the process was started."""
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "of_a_user.py").write_text("def twice(number: int) -> int:\n    return 2 * number\n")
    (tmp_path / "msgpack.py").write_text("raise SystemExit('a file of the current folder')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [str(tmp_path / "there"), *filter(None, sys.path)])
    assert dict(run_isolated(importlib.import_module("of_a_user").twice, [4], processes=1)) == {4: 8}
