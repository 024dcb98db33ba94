"""Define fixtures for all tests."""

from __future__ import annotations

import fcntl
import gc
import os
import socket
import subprocess
import sys
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import numba.core.dispatcher
import pytest
from hypothesis import HealthCheck, settings

# Hypothesis fails an example that takes longer than 200 ms, and a test whose inputs take longer than a time limit to
# draw: timing assertions, which a busy machine breaks.
settings.register_profile("v2v", deadline=None, print_blob=True, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("ci", parent=settings.get_profile("v2v"), derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "v2v")

_WARM_UP = [sys.executable, "-c", "from v2v_server.worker.warm_up import warm_up_in_turn; warm_up_in_turn()"]


@pytest.fixture(scope="session", autouse=True)
def _own_environment(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep the files of the tests out of the user's cache, and the user's settings and terminal out of the tests."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("V2V_KEYS", "PYTHONSAFEPATH", "NO_COLOR", "FORCE_COLOR"):
            patch.delenv(name, raising=False)
        patch.setenv("COLUMNS", "80")
        patch.setenv("V2V_CACHE_DIR", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture
def unused_port() -> Iterator[int]:
    """Return a port of 127.0.0.1 where nothing listens: a socket keeps it, so no other process can take it."""
    with socket.socket() as keeper:
        keeper.bind(("127.0.0.1", 0))
        yield keeper.getsockname()[1]


@pytest.fixture(scope="session", autouse=True)
def _probe_in_this_process() -> Iterator[None]:
    """Probe videos of commands called in this process here; programs that tests start use other processes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("v2v_tools.remake.usable_cores", lambda: 0)
        yield


def pytest_sessionstart(session: pytest.Session) -> None:
    """Compile the kernels that all workers run while the processes of a run of all tests collect them.

    Programs under test wait for this with the product's lock, and the test processes with theirs, which the process
    that compiles holds until it ends.
    """
    config = session.config
    if config.getoption("numprocesses", None) and config.args_source is pytest.Config.ArgsSource.TESTPATHS:
        with open(__file__, "rb") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            config.add_cleanup(subprocess.Popen(_WARM_UP, pass_fds=[lock.fileno()]).wait)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Let one process of a run collect first: the others find its compiled files."""
    with (Path(__file__).parent / "__init__.py").open("rb") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            fcntl.flock(lock, fcntl.LOCK_SH)
        return (yield)


def pytest_collection_finish() -> None:
    """Exclude all modules and collected tests from Python's garbage collections, which some tests ask for often."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def _one_process_compiles() -> Iterator[None]:
    """Let one test process compile at a time: the others wait, and then find its kernels in numba's cache."""
    dispatcher: Any = numba.core.dispatcher.Dispatcher
    compile_one = dispatcher.compile
    compiling = False

    def compile_in_turn(self: Any, signature: Any) -> Any:
        nonlocal compiling
        if compiling:  # a function that the one being compiled calls
            return compile_one(self, signature)
        fcntl.flock(lock, fcntl.LOCK_EX)
        compiling = True
        try:
            return compile_one(self, signature)
        finally:
            compiling = False
            fcntl.flock(lock, fcntl.LOCK_UN)

    with open(__file__, "rb") as lock, pytest.MonkeyPatch.context() as patch:  # this file, as the cache is the tree's
        patch.setattr(dispatcher, "compile", compile_in_turn)
        yield


@pytest.fixture(scope="session")
def compiled() -> None:
    """Compile the kernels before a server starts: on a busy host that takes longer than its consumers wait."""
    subprocess.run(_WARM_UP, check=True)
