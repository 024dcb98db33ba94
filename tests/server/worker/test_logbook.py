"""The logbook: what a worker was at, by its own hand, whatever ended it. The arenas of its leases."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator

import pytest

from v2v_client.memory import Arena
from v2v_protocol.arena import ArenaName, Slot
from v2v_protocol.errors import ProtocolError
from v2v_server.worker.logbook import IDLE, Logbook, note, take_arena
from v2v_server.worker.process import slot_arrays

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


@pytest.mark.parametrize("leases", [(7, IDLE, 2**64 - 1), (2**64 - 1, IDLE)])
def test_the_last_entry_survives_a_crash(book: Logbook, leases: tuple[int, ...]) -> None:
    command = [sys.executable, "-c", WRITES_AND_DIES, str(book.descriptor), *map(str, leases)]
    died = subprocess.run(command, pass_fds=(book.descriptor,), check=False)
    assert died.returncode == -signal.SIGSEGV
    assert book.lease() == leases[-1]


def test_a_worker_without_a_logbook_writes_nowhere() -> None:
    note(None, 5)


def test_it_has_no_name(book: Logbook) -> None:
    assert os.fstat(book.descriptor).st_nlink == 0


# --- arenas -----------------------------------------------------------------------------------------------------------

LAYOUT = {"voxels": ("int8", (2, 3))}
needs_memfd = pytest.mark.skipif(not hasattr(os, "memfd_create"), reason="this system has no memfd_create")


def name_of(arena: Arena) -> ArenaName:
    return ArenaName.parse(arena.slot(0).arena)


def write(book: Logbook, slot: Slot, value: int) -> bool:
    """Write to a slot as a confined worker does."""
    there = slot_arrays(slot, LAYOUT, lambda name, writable: take_arena(book.arenas, name, writable))
    if there is not None:
        there["voxels"].fill(value)
    return there is not None


def holds(arena: Arena, value: int) -> bool:
    return bool((arena.arrays(lambda: None)["voxels"][0] == value).all())


@needs_memfd
def test_a_descriptor_may_come_after_its_lease_but_not_much(book: Logbook) -> None:
    arena = Arena(LAYOUT, 2)
    book.arenas.settimeout(60.0)
    late = threading.Timer(0.5, book.lend, [str(name_of(arena))])
    late.start()
    assert write(book, arena.slot(0), 8)
    late.join()
    book.arenas.settimeout(0.01)
    assert not write(book, arena.slot(0), 9)
    assert holds(arena, 8)


@needs_memfd
def test_arenas_of_leases_that_were_not_worked_on_are_closed(book: Logbook) -> None:
    arenas = [Arena(LAYOUT, 2) for _ in range(5)]
    before = len(os.listdir("/proc/self/fd"))
    book.lend("1:65000:2:" + "0" * 32)  # gone: it costs only its own lease
    for arena in arenas:
        book.lend(str(name_of(arena)))
    assert write(book, arenas[3].slot(0), 7)
    assert write(book, arenas[4].slot(0), 8)
    assert len(os.listdir("/proc/self/fd")) == before
    assert [holds(arena, value) for arena, value in zip(arenas, (0, 0, 0, 7, 8), strict=True)] == [True] * 5


@needs_memfd
def test_what_the_pool_cannot_open_is_no_arena(book: Logbook) -> None:
    arena = Arena(LAYOUT, 2)
    name = name_of(arena)
    unknown = ArenaName(name.pid, name.descriptor, name.slots, "0" * 32)
    gone = ArenaName(name.pid, 65_000, name.slots, name.token)
    for each in (unknown, gone):
        book.lend(str(each))
        with pytest.raises(FileNotFoundError):
            take_arena(book.arenas, each, True)
    book.lend(str(name))
    assert not write(book, Slot(str(ArenaName(name.pid, name.descriptor, 3000, name.token)), 1), 5)  # another size
    with pytest.raises(ProtocolError):
        book.lend("no arena")


def test_an_ended_pool_lends_nothing(book: Logbook) -> None:
    with book.arenas.dup() as arenas:
        book.close()
        with pytest.raises(FileNotFoundError):
            take_arena(arenas, ArenaName(1, 1, 1, "0" * 32), True)


def test_a_worker_that_does_not_read_stops_no_pool(book: Logbook) -> None:
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(2000):
        book.lend("0:0:1:" + "0" * 32)
    assert len(os.listdir("/proc/self/fd")) == before
    book.arenas.close()
    book.lend("0:0:1:" + "0" * 32)
