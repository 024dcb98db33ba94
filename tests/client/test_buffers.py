import os
from contextlib import contextmanager

import numpy as np
import pytest
import torch

from v2v_client.memory import BatchBuffers, BatchMemory


def address(array: np.ndarray) -> int:
    return array.__array_interface__["data"][0]


HOLDS = {
    "a view": lambda array: array[1:, ::2],
    "a tensor": torch.from_numpy,
    "a view of a tensor": lambda array: torch.from_numpy(array).T[1:],
    "a storage": lambda array: torch.from_numpy(array).untyped_storage(),
    "an array of a tensor": lambda array: torch.from_numpy(array)[1:].numpy(),
    "DLPack": torch.from_dlpack,
    "a memoryview": memoryview,
}
every_hold = pytest.mark.parametrize("hold", HOLDS.values(), ids=HOLDS)


LAYOUT = {"voxels": ("int8", (2, 3)), "frames": ("uint8", (5,))}


def shaped(batch_size: int = 4, spare: int = 2) -> BatchBuffers:
    buffers = BatchBuffers()
    buffers.shape(LAYOUT, batch_size, spare=spare)
    return buffers


@every_hold
def test_referenced_memory_is_not_reused(hold):
    buffers = shaped()
    array = buffers.arrays()["voxels"].reshape(4, 6)
    array[:] = 7
    first = address(array)
    held = hold(array)
    del array
    other = buffers.arrays()["voxels"]
    assert address(other) != first
    other[:] = 9
    del held
    again = buffers.arrays()["voxels"]
    assert address(again) == first, "the last user is gone, yet the memory did not come back"
    assert (again == 7).all(), "memory in use was written to"


def test_at_most_the_stated_memory_is_kept():
    buffers = shaped()
    arrays = [buffers.arrays()["voxels"] for _ in range(5)]
    addresses = {address(array) for array in arrays}
    del arrays
    kept = [buffers.arrays()["voxels"] for _ in range(2)]
    assert {address(array) for array in kept} <= addresses
    assert len(buffers._free) == 0


def sample(value: int) -> dict[str, np.ndarray]:
    return {name: np.full(shape, value, dtype) for name, (dtype, shape) in LAYOUT.items()}


def filled(memory: BatchMemory) -> dict[str, np.ndarray]:
    for row in range(4):
        memory.fill(row, sample(row))
    return memory.finish()


def arena_of(memory: BatchMemory) -> str:
    return memory.slot(0).arena


@pytest.mark.parametrize("shared", [False, True])
def test_a_batch_has_the_rows_written_to_it(shared):
    whole = filled(shaped().take(shared=shared))
    assert {name: (str(array.dtype), array.shape) for name, array in whole.items()} == {
        "voxels": ("int8", (4, 2, 3)),
        "frames": ("uint8", (4, 5)),
    }
    assert all(array.flags.c_contiguous and array.flags.writeable for array in whole.values())
    assert all((array[row] == row).all() for array in whole.values() for row in range(4))


def test_a_batch_leaves_its_arena_if_a_worker_may_still_write():
    """It takes along the samples already there, and those that other workers still write there."""
    buffers = shaped()
    memory = buffers.take(shared=True)
    for row in range(4):
        arena = memory._arena or memory._left
        if row in (1, 3):
            arena.put(row, sample(row))  # as a worker does
        memory.fill(row, None if row in (1, 3) else sample(row), slot_is_free=row != 2)
    assert memory.has_slots
    left = memory._left
    whole = memory.finish()
    left.put(2, sample(99))
    assert all((array[row] == row).all() for array in whole.values() for row in range(4))


def test_memory_of_another_shape_is_released():
    buffers = shaped()
    place = address(buffers.arrays()["voxels"])
    buffers.shape(dict(LAYOUT), 4, spare=2)
    assert address(buffers.arrays()["voxels"]) == place
    buffers.shape(LAYOUT, 2, spare=2)
    assert buffers.arrays()["voxels"].shape == (2, 2, 3)


@every_hold
def test_an_arena_with_a_referenced_batch_is_not_reused(hold):
    buffers = shaped()
    memory = buffers.take(shared=True)
    name, whole = arena_of(memory), filled(memory)
    held = hold(whole["voxels"].reshape(4, 6))
    del memory, whole
    others = [buffers.take(shared=True) for _ in range(3)]
    assert name not in map(arena_of, others)
    del held
    assert arena_of(buffers.take(shared=True)) == name


def test_an_arena_with_an_incomplete_batch_is_not_reused():
    buffers = shaped()
    memory = buffers.take(shared=True)
    name = arena_of(memory)
    del memory
    assert arena_of(buffers.take(shared=True)) != name


@contextmanager
def forked(check):
    """Fork a process before the block, run its checks after the block, and require that they succeed."""
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        status = 1
        try:
            os.close(writing)
            os.read(reading, 1)
            check()
            status = 0
        finally:
            os._exit(status)
    os.close(reading)
    try:
        yield
    finally:
        os.close(writing)
        _, status = os.waitpid(pid, 0)
    assert status == 0


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_an_arena_in_use_during_a_fork_is_not_reused():
    buffers = shaped()
    memory = buffers.take(shared=True)
    name, mine = arena_of(memory), filled(memory)

    def still_there():
        assert len(mine) == 2
        assert all((array[row] == row).all() for array in mine.values() for row in range(4))

    with forked(still_there):
        mine.clear()
        del memory
        for _ in range(3):
            memory = buffers.take(shared=True)
            assert arena_of(memory) != name
            memory.fill(2, sample(99))
            memory.finish()


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_forked_process_does_not_reuse_its_parents_arenas():
    buffers = shaped()
    memory = buffers.take(shared=True)
    name = arena_of(memory)
    filled(memory)
    del memory

    def uses_another():
        assert arena_of(buffers.take(shared=True)) != name

    with forked(uses_another):
        pass
    assert arena_of(buffers.take(shared=True)) == name
