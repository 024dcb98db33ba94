"""Test an arena from both ends: a sample that a worker writes there is a row of the consumer's batch, or the worker
reports that it could not write it."""

from __future__ import annotations

import fcntl
import mmap
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from v2v_client.memory import Arena, open_arena
from v2v_protocol.arena import MOST_SLOTS, NO_SLOT, ArenaName, Slot, array_offsets
from v2v_protocol.errors import ProtocolError
from v2v_server.worker.process import slot_arrays

pytestmark = pytest.mark.skipif(not hasattr(os, "memfd_create"), reason="this system has no memfd_create")

LAYOUT = {"voxels": ("int8", (3, 5, 7, 11)), "flow": ("float16", (3, 2, 7, 11)), "frames": ("uint8", (3, 1, 7, 11))}
ROWS = 5


def sample(seed: int) -> dict[str, np.ndarray]:
    draw = np.random.default_rng(seed)
    return {name: draw.integers(0, 100, shape).astype(dtype) for name, (dtype, shape) in LAYOUT.items()}


def write(slot: Slot, seed: int) -> bool:
    """Write to a slot as a worker does."""
    there = slot_arrays(slot, LAYOUT)
    for name, array in sample(seed).items():
        if there is not None:
            there[name][...] = array
    return there is not None


def holds(arrays: dict[str, np.ndarray], row: int, seed: int) -> bool:
    return all(np.array_equal(arrays[name][row], array) for name, array in sample(seed).items())


def ignore() -> None:
    pass


@pytest.fixture
def arena() -> Arena:
    return Arena(LAYOUT, ROWS)


def allocated(arena: Arena) -> int:
    return os.stat(ArenaName.parse(arena.slot(0).arena).path).st_blocks * 512


def test_an_unwritten_mapping_is_reused(arena: Arena) -> None:
    assert write(arena.slot(2), 1)
    arrays = arena.arrays(ignore)
    first = arrays["voxels"].ctypes.data
    assert holds(arrays, 2, 1)
    del arrays
    assert write(arena.slot(2), 2)
    arrays = arena.arrays(ignore)
    assert arrays["voxels"].ctypes.data == first
    assert holds(arrays, 2, 2)


@pytest.mark.parametrize("name", list(LAYOUT))
@pytest.mark.parametrize("row", [0, ROWS - 1])
def test_writes_to_an_earlier_batch_do_not_reappear(arena: Arena, name: str, row: int) -> None:
    for other in range(ROWS):
        assert write(arena.slot(other), other)
    arrays = arena.arrays(ignore)
    arrays[name][row].reshape(-1)[-1] += 1
    assert not holds(arrays, row, row)
    del arrays
    assert write(arena.slot(1), 7)
    arrays = arena.arrays(ignore)
    assert [holds(arrays, other, 7 if other == 1 else other) for other in range(ROWS)] == [True] * ROWS


@pytest.mark.parametrize("said", ["nothing", "zeros", "too little"])
def test_without_pagemap_an_earlier_write_does_not_reappear(
    arena: Arena, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def pread(descriptor: int, count: int, offset: int) -> bytes:
        if said == "nothing":
            raise PermissionError
        return bytes(count) if said == "zeros" else really(descriptor, count - 8, offset)

    really = os.pread
    monkeypatch.setattr(os, "pread", pread)
    assert write(arena.slot(ROWS - 1), 5)
    arena.arrays(ignore)["frames"].reshape(-1)[-1] += 1  # in the last page, which the short answer leaves out
    assert holds(arena.arrays(ignore), ROWS - 1, 5)


def test_a_file_that_is_not_the_named_arena_is_not_written(arena: Arena, tmp_path: Path) -> None:
    name = ArenaName.parse(arena.slot(0).arena)
    other = os.memfd_create("v2v-other")
    file = os.open(tmp_path / "file", os.O_RDWR | os.O_CREAT)
    try:
        for descriptor in (other, file, 9999):
            assert not write(Slot(str(ArenaName(name.pid, descriptor, ROWS, name.token)), 1), 1)
        assert not write(Slot(str(ArenaName(name.pid, name.descriptor, ROWS, "0" * 32)), 1), 1)
        assert not write(Slot("../../etc/passwd", 1), 1)
        assert not write(Slot(str(name), ROWS + 1), 1)
        assert not write(Slot(str(name), NO_SLOT), 1)
        assert (os.fstat(other).st_size, os.fstat(file).st_size, allocated(arena)) == (0, 0, 0)
    finally:
        os.close(other)
        os.close(file)


@pytest.mark.parametrize("flaw", ["not sealed", "too small", "of more slots"])
def test_unsealed_memory_is_not_written(flaw: str) -> None:
    """Writing to a page that is missing, or removed meanwhile, kills the process by a signal."""
    good = ArenaName.parse(Arena(LAYOUT, ROWS).slot(0).arena)
    *_, size = array_offsets([np.dtype(dtype).itemsize * int(np.prod(shape)) for dtype, shape in LAYOUT.values()], ROWS)
    descriptor = os.memfd_create(good.memory_name, os.MFD_ALLOW_SEALING)
    try:
        os.ftruncate(descriptor, size - 4096 if flaw == "too small" else size)
        if flaw != "not sealed":
            fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)
        name = ArenaName(os.getpid(), descriptor, ROWS + 100 * (flaw == "of more slots"), good.token)
        assert not write(Slot(str(name), 1), 1)
        assert os.fstat(descriptor).st_blocks == 0
    finally:
        os.close(descriptor)


def test_its_size_cannot_be_changed(arena: Arena) -> None:
    name = ArenaName.parse(arena.slot(0).arena)
    for size in (0, os.fstat(name.descriptor).st_size + 1):
        with pytest.raises(PermissionError):
            os.ftruncate(name.descriptor, size)


def test_a_worker_keeps_no_descriptor_of_an_arena_and_opens_none_of_a_dead_consumer(arena: Arena) -> None:
    of_dead = Arena(LAYOUT, ROWS).slot(0)
    before = set(os.listdir("/proc/self/fd"))
    assert write(arena.slot(0), 1)
    assert not write(of_dead, 1)
    assert set(os.listdir("/proc/self/fd")) == before
    assert ArenaName.parse(arena.slot(0).arena).token not in Path("/proc/self/maps").read_text()


def test_without_memfd_there_is_no_arena(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "memfd_create")
    assert open_arena(LAYOUT, ROWS) is None


@given(
    pid=st.integers(0, 2**32),
    descriptor=st.integers(0, 2**31),
    slots=st.integers(1, MOST_SLOTS),
    token=st.binary(min_size=16, max_size=16),
)
def test_arena_names_round_trip_through_text(pid: int, descriptor: int, slots: int, token: bytes) -> None:
    name = ArenaName(pid, descriptor, slots, token.hex())
    assert ArenaName.parse(str(name)) == name


@given(st.text(max_size=60) | st.from_regex(r"[0-9]{1,3}:[0-9]{1,3}:[0-9]{0,7}:[0-9a-f]{32}", fullmatch=True))
def test_other_texts_are_not_arena_names(text: str) -> None:
    try:
        name = ArenaName.parse(text)
    except ProtocolError:
        return
    assert name.path.startswith("/proc/")
    assert name.path.count("/") == 4
    assert 0 < name.slots <= MOST_SLOTS


@given(st.lists(st.integers(1, 10**9), min_size=1, max_size=5), st.integers(1, MOST_SLOTS))
def test_arrays_begin_at_whole_pages_and_do_not_overlap(sizes: list[int], slots: int) -> None:
    offsets = array_offsets(sizes, slots)
    assert offsets[0] == 0
    assert len(offsets) == len(sizes) + 1
    for size, begin, end in zip(sizes, offsets, offsets[1:], strict=False):
        assert begin % mmap.PAGESIZE == 0
        assert size * slots <= end - begin < size * slots + mmap.PAGESIZE
