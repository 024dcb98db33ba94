"""Jobs in processes of their own: crashes cost one job, and nothing is left running.

What the processes import is this module, so it imports little.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator

import psutil
import pytest

from v2v_server.video.isolate import Died, run_isolated


@pytest.fixture(autouse=True)
def _no_process_left() -> Iterator[None]:
    yield
    assert not psutil.wait_procs(children(), timeout=10)[1]


def children() -> list[psutil.Process]:
    """Processes below this one, but for the tracker that multiprocessing keeps as long as its own process lives."""
    below = psutil.Process().children(recursive=True)
    return [process for process in below if "resource_tracker" not in " ".join(process.cmdline())]


def square_or_die(number: int) -> int:
    if number == 3:
        os.kill(os.getpid(), signal.SIGSEGV)
    if number == 5:
        os._exit(7)
    return number * number


def test_a_crash_costs_one_job() -> None:
    results = dict(run_isolated(square_or_die, range(9), processes=2))
    assert results.pop(3) == Died("signal SIGSEGV")
    assert results.pop(5) == Died("exit status 7")
    assert results == {n: n * n for n in (0, 1, 2, 4, 6, 7, 8)}
    assert dict(run_isolated(square_or_die, [1, 2], processes=0)) == {1: 1, 2: 4}
    assert dict(run_isolated(square_or_die, [], processes=2)) == {}


def test_leaving_early_ends_the_processes() -> None:
    results = run_isolated(square_or_die, range(3), processes=2)
    next(results)
    results.close()  # type: ignore[attr-defined]
    assert not children()
