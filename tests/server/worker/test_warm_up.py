"""One process compiles, the others wait; and every way in which that may fail ends in each compiling for itself."""

from __future__ import annotations

import errno
import fcntl
import os
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path
from typing import Any

import psutil
import pytest

from tests.waiting import has_ended, until
from v2v_server.worker import warm_up as module
from v2v_server.worker.warm_up import one_compiles, warm_up_in_turn

KEY = "key"


def is_held(folder: Path) -> bool:
    """Return whether a process has the lock."""
    with (folder / f"{KEY}.lock").open("ab") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def test_the_first_process_holds_the_lock_and_later_ones_need_none(tmp_path: Path) -> None:
    with one_compiles(tmp_path / f"{KEY}.complete") as is_first:
        assert is_first
        assert is_held(tmp_path)
    assert not is_held(tmp_path)
    with one_compiles(tmp_path / f"{KEY}.complete") as is_first:
        assert not is_first
        assert not is_held(tmp_path)


def test_the_second_waits_and_then_holds_nothing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    order: list[Any] = []
    waits = threading.Event()
    monkeypatch.setattr(time, "sleep", lambda seconds: waits.set())

    def second() -> None:
        with one_compiles(tmp_path / f"{KEY}.complete") as is_first:
            order.append((is_first, is_held(tmp_path)))

    thread = threading.Thread(target=second)
    with one_compiles(tmp_path / f"{KEY}.complete"):
        thread.start()
        assert waits.wait(60.0)
        order.append("the first is done")
    thread.join(60.0)
    assert order == ["the first is done", (False, False)]


def test_one_that_fails_leaves_the_work_to_the_next(tmp_path: Path) -> None:
    with pytest.raises(MemoryError), one_compiles(tmp_path / f"{KEY}.complete"):
        raise MemoryError
    assert not is_held(tmp_path)
    with one_compiles(tmp_path / f"{KEY}.complete") as is_first:
        assert is_first


@pytest.mark.slow
def test_a_confined_process_compiles_in_its_own_memory(tmp_path: Path) -> None:
    """A stream that needs an unusual kernel may come to workers on a host that has not compiled it yet."""
    code = (
        "import sys\nfrom pathlib import Path\n"
        "from v2v_server.simulation.precision import Variant\n"
        "from v2v_server.system.sandbox import can_confine, confine\n"
        "from v2v_server.worker.warm_up import is_compiled, load_in_turn\n"
        "variant = Variant('int16', False, 'float64')\n"
        "assert not is_compiled(variant)\n"
        "assert confine([Path(sys.argv[1])], network=False).calls == can_confine().calls\n"
        "load_in_turn(variant)\nassert is_compiled(variant)\n"
    )
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], env=environment, check=True)


@pytest.mark.parametrize(("key", "longest"), [(KEY, 0.0), ("another", 60.0)], ids=["stuck", "another processor"])
def test_a_process_that_is_stuck_or_compiles_for_another_processor_is_not_waited_for(
    tmp_path: Path, key: str, longest: float
) -> None:
    with (
        one_compiles(tmp_path / f"{KEY}.complete"),
        one_compiles(tmp_path / f"{key}.complete", longest_wait_seconds=longest) as is_first,
    ):
        assert is_first


def test_without_locks_all_compile_at_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def flock(*_: Any) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", flock)
    with one_compiles(tmp_path / f"{KEY}.complete") as one, one_compiles(tmp_path / f"{KEY}.complete") as other:
        assert one
        assert other


def test_without_a_folder_all_compile_at_once(tmp_path: Path) -> None:
    absent = tmp_path / "absent"
    with one_compiles(absent / f"{KEY}.complete") as one, one_compiles(absent / f"{KEY}.complete") as other:
        assert one
        assert other
    assert not absent.exists()


def test_once_all_is_there_it_is_only_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Or compiled here, where the cache has been emptied around the mark: no process waits for another."""
    warm_up_in_turn()
    calls = []
    monkeypatch.setattr(module, "load_kernels", lambda: calls.append("compiled or loaded"))
    monkeypatch.setattr(module.subprocess, "run", lambda *_, **__: calls.append("compiled apart"))
    warm_up_in_turn()
    assert calls == ["compiled or loaded"]


@pytest.mark.slow
def test_workers_neither_compile_nor_grow(tmp_path: Path) -> None:
    """The compiler's memory goes with the process that compiled: it is at least 50 MB that no worker holds."""
    code = (
        "import resource\n"
        "from v2v_server.simulation.kernels import simulate_pixels, simulate_general\n"
        "from v2v_server.simulation.pixel import words\n"
        "from v2v_server.worker.warm_up import warm_up_in_turn\n"
        "warm_up_in_turn()\n"
        "from v2v_server.video.levels import to_full_range\n"
        "kernels = simulate_pixels, simulate_general, words, to_full_range\n"
        "print(*(sum(kernel.stats.cache_hits.values()) for kernel in kernels))\n"
        "print(*(sum(kernel.stats.cache_misses.values()) for kernel in kernels))\n"
        "status = open('/proc/self/status').read()\n"  # getrusage would count the memory of the parent before exec
        "print(status.split('VmHWM:')[1].split()[0], resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)\n"
    )
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    start = [sys.executable, "-c", code]
    with ExitStack() as stack:
        both = []
        for _ in range(2):
            process = subprocess.Popen(start, stdout=subprocess.PIPE, text=True, env=environment)
            both.append(stack.enter_context(process))
            stack.callback(process.kill)
        said = [process.communicate()[0].splitlines() for process in both]
    assert [lines[0].split() for lines in said] == [["3", "1", "1", "1"]] * 2
    assert [lines[1].split() for lines in said] == [["0", "0", "0", "0"]] * 2
    workers, compilers = zip(*(map(int, lines[2].split()) for lines in said), strict=True)
    assert max(workers) < max(compilers) - 50_000  # KiB
    assert len(list(tmp_path.rglob("*.complete"))) == 1


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux ends a child with its parent")
def test_the_compiler_dies_with_its_worker(tmp_path: Path) -> None:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    start = [sys.executable, "-c", "from v2v_server.worker.warm_up import warm_up_in_turn; warm_up_in_turn()"]
    with subprocess.Popen(start, env=environment) as worker:
        seen: list[psutil.Process] = []
        try:
            until(lambda: seen.extend(psutil.Process(worker.pid).children()) or seen)
        finally:
            worker.kill()
    until(lambda: all(map(has_ended, seen)))


def test_scipy_cannot_be_imported_while_kernels_are_loaded_unless_it_was_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Numba itself imports ``scipy``, so blocking that name would come too late."""
    name = "scipy.linalg"
    for loaded in [each for each in sys.modules if each.startswith(name)]:
        monkeypatch.delitem(sys.modules, loaded)
    with module._without_scipy(), pytest.raises(ImportError):
        import_module("scipy.linalg.cython_blas")
    assert name not in sys.modules
    monkeypatch.setitem(sys.modules, name, sys)
    with module._without_scipy():
        assert import_module(name) is sys
    assert sys.modules[name] is sys
