"""The logbook: what a worker was at, by its own hand, whatever ended it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator

import pytest

from v2v_server.worker.logbook import IDLE, Logbook, note

WRITES_AND_DIES = """
import os, signal, sys
from v2v_server.worker.logbook import IDLE, note
for lease in map(int, sys.argv[2:]):
    note(int(sys.argv[1]), lease)
os.kill(os.getpid(), signal.SIGSEGV)
"""


@pytest.fixture
def book() -> Iterator[Logbook]:
    made = Logbook()
    yield made
    made.close()


def test_nothing_written_is_nothing_known(book: Logbook) -> None:
    assert book.lease() is None


@pytest.mark.parametrize("leases", [(7,), (7, IDLE), (7, IDLE, 2**64 - 1), (2**64 - 1, 1)])
def test_the_last_entry_survives_a_crash(book: Logbook, leases: tuple[int, ...]) -> None:
    command = [sys.executable, "-c", WRITES_AND_DIES, str(book.descriptor), *map(str, leases)]
    died = subprocess.run(command, pass_fds=(book.descriptor,), check=False)
    assert died.returncode == -signal.SIGSEGV
    assert book.lease() == leases[-1]


def test_a_worker_without_a_logbook_writes_nowhere() -> None:
    note(None, 5)


def test_it_has_no_name(book: Logbook) -> None:
    assert os.fstat(book.descriptor).st_nlink == 0
