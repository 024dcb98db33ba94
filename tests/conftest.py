"""Define fixtures for all tests."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import numba.core.dispatcher
import pytest
from hypothesis import settings

# Hypothesis fails an example that takes longer than 200 ms: a timing assertion, which a busy machine breaks.
settings.register_profile("v2v", deadline=None, print_blob=True)
settings.register_profile("ci", parent=settings.get_profile("v2v"), derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "v2v")


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep catalogue indexes and quarantine files of the tests out of the user's cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("V2V_CACHE_DIR", str(tmp_path_factory.mktemp("cache")))
        yield


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
        program = "from v2v_server.worker.warm_up import warm_up_in_turn; warm_up_in_turn()"
        with open(__file__, "rb") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            config.add_cleanup(subprocess.Popen([sys.executable, "-c", program], pass_fds=[lock.fileno()]).wait)


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
