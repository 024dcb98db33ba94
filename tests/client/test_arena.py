"""An arena from both ends: what a worker puts there is what the consumer reads, or the worker says it could not."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from v2v_client.arena import Arena, open_arena
from v2v_client.slots import Answer, Slots
from v2v_protocol.arena import NO_SLOT, ArenaName, slot_bytes
from v2v_protocol.errors import ProtocolError
from v2v_server.handover import put

pytestmark = pytest.mark.skipif(not hasattr(os, "memfd_create"), reason="this system has no memfd_create")

LAYOUT = {"voxels": ("int8", (3, 5, 7, 11)), "flow": ("float16", (3, 2, 7, 11)), "frames": ("uint8", (3, 1, 7, 11))}


def sample(seed: int) -> dict[str, np.ndarray]:
    draw = np.random.default_rng(seed)
    return {name: draw.integers(0, 100, shape).astype(dtype) for name, (dtype, shape) in LAYOUT.items()}


def rows() -> dict[str, np.ndarray]:
    return {name: np.zeros((4, *shape), dtype)[2] for name, (dtype, shape) in LAYOUT.items()}


@pytest.fixture
def arena() -> Iterator[Arena]:
    opened = Arena(LAYOUT)
    yield opened
    opened.close()


def allocated(arena: Arena) -> int:
    return os.stat(ArenaName.parse(arena.name).path).st_blocks * 512


def test_what_was_put_is_read_slot_by_slot(arena: Arena) -> None:
    for slot in (3, 1, 2):
        assert put(arena.name, slot, sample(slot))
    for slot in (1, 2, 3):
        into = rows()
        arena.read(slot, into)
        assert all(np.array_equal(into[name], array) for name, array in sample(slot).items())


def test_another_process_of_this_user_can_put(arena: Arena) -> None:
    code = (
        "import sys; from tests.client.test_arena import sample; from v2v_server.handover import put; "
        "sys.exit(not put(sys.argv[1], 4, sample(4)))"
    )
    assert subprocess.run([sys.executable, "-c", code, arena.name], timeout=60, check=False).returncode == 0
    into = rows()
    arena.read(4, into)
    assert all(np.array_equal(into[name], array) for name, array in sample(4).items())


def test_less_than_a_sample_is_an_error(arena: Arena) -> None:
    assert put(arena.name, 1, {"voxels": sample(0)["voxels"]})
    with pytest.raises(ProtocolError, match=r"slot 1 ends \d+ bytes before array 'flow' is complete"):
        arena.read(1, rows())


def test_what_is_not_the_named_arena_is_not_touched(arena: Arena, tmp_path: os.PathLike[str]) -> None:
    name = ArenaName.parse(arena.name)
    other = os.memfd_create("v2v-other")
    file = os.open(os.path.join(tmp_path, "file"), os.O_RDWR | os.O_CREAT)
    try:
        for descriptor in (other, file, 9999):
            assert not put(str(ArenaName(name.pid, descriptor, name.token)), 1, sample(1))
        assert not put(str(ArenaName(name.pid, name.descriptor, "0" * 32)), 1, sample(1))
        assert not put("../../etc/passwd", 1, sample(1))
        assert (os.fstat(other).st_size, os.fstat(file).st_size, allocated(arena)) == (0, 0, 0)
    finally:
        os.close(other)
        os.close(file)


def test_the_arena_of_a_consumer_that_is_gone_cannot_be_reached_and_leaves_no_descriptor() -> None:
    gone = Arena(LAYOUT)
    name = gone.name
    gone.close()
    before = set(os.listdir("/proc/self/fd"))
    assert not put(name, 1, sample(1))
    assert set(os.listdir("/proc/self/fd")) == before


def test_freed_slots_cost_no_memory_even_if_written_to_since(arena: Arena) -> None:
    big = Arena({"voxels": ("int8", (1 << 20,))})
    try:
        ones = {"voxels": np.ones(1 << 20, np.int8)}
        for slot in (1, 2, 3):
            assert put(big.name, slot, ones)
        assert allocated(big) == 3 << 20
        big.free(2)
        assert allocated(big) == 2 << 20
        assert put(big.name, 2, ones)  # by a worker that was given up
        assert allocated(big) == 3 << 20
        big.free(3)
        assert allocated(big) == 1 << 20
        into = {"voxels": np.zeros(1 << 20, np.int8)}
        big.read(1, into)
        assert into["voxels"].all()
    finally:
        big.close()


def test_without_memfd_there_is_no_arena(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "memfd_create")
    assert open_arena(LAYOUT) is None


@given(pid=st.integers(0, 2**32), descriptor=st.integers(0, 2**31), token=st.binary(min_size=16, max_size=16))
def test_a_name_survives_its_text(pid: int, descriptor: int, token: bytes) -> None:
    name = ArenaName(pid, descriptor, token.hex())
    assert ArenaName.parse(str(name)) == name


@given(st.text(max_size=60))
def test_other_text_names_no_arena(text: str) -> None:
    try:
        name = ArenaName.parse(text)
    except ProtocolError:
        return
    assert name.path.startswith("/proc/")
    assert name.path.count("/") == 4


@given(st.lists(st.integers(1, 10**9), min_size=1, max_size=5))
def test_slots_are_whole_pages_and_hold_the_arrays(sizes: list[int]) -> None:
    assert sum(sizes) <= slot_bytes(sizes) < sum(sizes) + 4096
    assert slot_bytes(sizes) % 4096 == 0


def test_a_slot_is_used_again_only_when_its_worker_has_said_so() -> None:
    slots = Slots()
    assert [slots.take(index) for index in (10, 11, 12)] == [1, 2, 3]
    assert slots.answered(10, 1, in_message=False) is Answer.THERE
    assert slots.take(13) == 4  # 1 is not read yet
    slots.give_back(1)
    assert slots.take(14) == 1
    assert slots.answered(11, 2, in_message=True) is Answer.MESSAGE
    assert slots.take(15) == 2
    assert slots.answered(12, NO_SLOT, in_message=True) is Answer.ABANDONED
    assert slots.take(16) == 5
    assert slots.answered(13, 3, in_message=False) is Answer.NOWHERE
    assert slots.of(13) == 4
    assert slots.answered(99, NO_SLOT, in_message=True) is Answer.MESSAGE
    assert slots.answered(99, 7, in_message=False) is Answer.NOWHERE
