"""The ring: what it holds, what it drops, and that what it hands out cannot be written to."""

from __future__ import annotations

import errno
import mmap
import os
import resource
from collections.abc import Sequence
from typing import Any

import hypothesis.strategies as st
import numpy.typing as npt
import pytest
from hypothesis import given

from tests.server.peers import frames_of
from v2v_client.memory import open_sample
from v2v_protocol.arena import ArenaName, Slot, open_memory
from v2v_protocol.messages import Frames, SampleHeader, decode
from v2v_server.sharing import SampleRing, SharedSample, mappings
from v2v_server.worker.process import slot_arrays

LAYOUT = {"voxels": ("int8", (3, 5)), "frames": ("uint8", (7,))}
SIZES = (15, 7)
PAGES = 2 * 4096
SLOT = Slot(f"1:2:3:{'0' * 32}", 3)


def header(index: int = 0) -> SampleHeader:
    message = decode(frames_of(LAYOUT, 0, index, 0, slot=1)[0])
    assert isinstance(message, SampleHeader)
    return message


def fill(ring: SampleRing, lease: int, value: int) -> dict[str, npt.NDArray[Any]]:
    """As a worker does with the slot of its lease."""
    slot = ring.lend(lease, SIZES)
    assert slot is not None
    arrays = slot_arrays(slot, LAYOUT)
    assert arrays is not None
    for array in arrays.values():
        array[:] = value
    return arrays


def filled() -> tuple[SampleRing, SharedSample]:
    """A ring with one sample that a worker wrote to its memory."""
    ring = SampleRing(1 << 20)
    fill(ring, 1, 9)
    return ring, ring.add("key", 1, header(), [])


def read(message: Frames) -> list[bytes]:
    """As a consumer does: the bytes of each array, in the message or in the memory that it names."""
    answer = decode(message[0])
    assert isinstance(answer, SampleHeader)
    arrays: Sequence[object] = open_sample(answer.arena, SIZES) if answer.arena else message[1:]
    return [bytes(array) for array in arrays]  # type: ignore[call-overload]


def content(value: int) -> list[bytes]:
    return [bytes([value]) * size for size in SIZES]


@pytest.mark.parametrize("slot", [None, SLOT])
def test_every_consumer_reads_what_the_worker_wrote(slot: Slot | None) -> None:
    ring, sample = filled()
    for is_first in (True, False):
        message = sample.message(slot, is_first=is_first)
        answer = decode(message[0])
        assert isinstance(answer, SampleHeader)
        assert (len(message) == 1, bool(answer.arena)) == (slot is not None, slot is not None)
        assert answer.slot == (0 if slot is None else slot.number)
        assert (answer.decoded, answer.cpu_seconds > 0) == (is_first, is_first)
        assert read(message) == content(9)
    assert ring.get("key") is sample
    assert ring.get("other") is None


def open_files() -> int:
    return len(os.listdir("/proc/self/fd"))


def test_all_messages_of_a_sample_share_one_mapping() -> None:
    (_, sample), before = filled(), open_files()
    messages = [sample.message(None, is_first=False) for _ in range(100)]
    assert open_files() == before + 1
    assert all(read(message) == content(9) for message in messages)


def test_without_a_descriptor_for_a_mapping_a_sample_is_copied(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: object) -> None:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    _, sample = filled()
    monkeypatch.setattr("v2v_protocol.arena.mmap.mmap", refuse)
    assert read(sample.message(None, is_first=True)) == content(9)


def test_samples_on_their_way_count_against_the_open_files(monkeypatch: pytest.MonkeyPatch) -> None:
    """The ring has dropped them, and their messages still hold a descriptor each."""
    ring, on_their_way = SampleRing(1), list[Frames]()
    used = len(mappings)
    monkeypatch.setattr(resource, "getrlimit", lambda which: (4 * (used + 10), 4 * (used + 10)))
    while ring.lend(99, SIZES) is not None:
        ring.release(())
        fill(ring, len(on_their_way), 9)
        on_their_way.append(ring.add("key", len(on_their_way), header(), []).message(None, is_first=True))
    assert 5 <= len(on_their_way) <= 10
    on_their_way.clear()
    assert ring.lend(0, SIZES) is not None


def test_finished_memory_cannot_be_written_to() -> None:
    _, sample = filled()
    answer = decode(sample.message(SLOT, is_first=True)[0])
    assert isinstance(answer, SampleHeader)
    descriptor = open_memory(ArenaName.parse(answer.arena), PAGES, writable=True)
    try:
        with pytest.raises(OSError, match="not permitted"):
            os.pwrite(descriptor, b"x", 0)
        with pytest.raises(OSError, match="not permitted"):
            mmap.mmap(descriptor, PAGES, mmap.MAP_SHARED)
    finally:
        os.close(descriptor)


def test_memory_that_a_worker_can_still_write_to_is_copied() -> None:
    ring = SampleRing(1 << 20)
    arrays = fill(ring, 1, 9)
    message = ring.add("key", 1, header(), []).message(SLOT, is_first=True)
    arrays["voxels"][:] = 3
    assert len(message) == 3
    assert read(message) == content(9)


def test_memory_is_read_only_once_it_is_sealed() -> None:
    ring = SampleRing(1 << 20)
    slot = ring.lend(1, SIZES)
    assert slot is not None
    assert open_sample(slot.arena, SIZES) == []
    assert open_sample("nonsense", SIZES) == []


def test_a_sample_in_a_message_is_kept_as_one() -> None:
    ring = SampleRing(1 << 20)
    ring.lend(1, SIZES)  # the worker is on another host
    sample = ring.add("key", 1, header(), content(4))
    assert sample.nbytes == sum(SIZES)
    assert read(sample.message(SLOT, is_first=False)) == content(4)
    assert ring.lent(1) is None


def test_memory_of_leases_that_have_ended_is_freed() -> None:
    ring = SampleRing(1 << 20)
    slots = [ring.lend(lease, SIZES) for lease in (1, 2)]
    ring.release({2})
    assert ring.lent(1) is None
    assert ring.lent(2) == slots[1]
    assert slots[0] is not None
    assert slot_arrays(slots[0], LAYOUT) is None


@given(most=st.integers(1, 5), keys=st.lists(st.integers(0, 7), max_size=20))
def test_the_newest_samples_within_the_limit_are_there(most: int, keys: list[int]) -> None:
    ring, newest = SampleRing(most * PAGES), list[int]()
    for lease, key in enumerate(keys):
        fill(ring, lease, key)
        ring.add(key, lease, header(), [])
        newest = [*(other for other in newest if other != key), key][-most:]
        found = {key: sample for key in range(8) if (sample := ring.get(key)) is not None}
        assert set(found) == set(newest)
        for key, sample in found.items():
            assert read(sample.message(SLOT, is_first=False)) == content(key)
