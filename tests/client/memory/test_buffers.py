import gc
import os
from contextlib import contextmanager

import numpy as np
import pytest
import torch

from v2v_client.memory.buffers import BatchBuffers, BufferPool, Memory, SharedMemory


def address(array: np.ndarray) -> int:
    return array.__array_interface__["data"][0]


def held_as_view(array):
    return array[1:, ::2]


def held_as_tensor(array):
    return torch.from_numpy(array)


def held_as_view_of_tensor(array):
    return torch.from_numpy(array).T[1:]


def held_as_storage(array):
    return torch.from_numpy(array).untyped_storage()


def held_as_array_of_tensor(array):
    return torch.from_numpy(array)[1:].numpy()


def held_as_dlpack(array):
    return torch.from_dlpack(array)


def held_as_memoryview(array):
    return memoryview(array)


HOLDS = [
    held_as_view,
    held_as_tensor,
    held_as_view_of_tensor,
    held_as_storage,
    held_as_array_of_tensor,
    held_as_dlpack,
    held_as_memoryview,
]


@pytest.mark.parametrize("hold", HOLDS)
def test_a_buffer_is_not_used_again_while_anything_looks_at_it(hold):
    pool = BufferPool("int16", (3, 4), spare=2)
    array = pool.take()
    array[:] = 7
    first = address(array)
    held = hold(array)
    del array
    other = pool.take()
    assert address(other) != first
    other[:] = 9
    del held
    gc.collect()
    again = pool.take()
    assert address(again) == first, "the last user is gone, yet the buffer did not come back"
    assert (again == 7).all(), "somebody wrote into a buffer that was held"


def test_arrays_have_the_asked_form():
    array = BufferPool("float32", (2, 3, 4), spare=1).take()
    assert array.shape == (2, 3, 4)
    assert array.dtype == np.float32
    assert array.flags.c_contiguous
    assert array.flags.writeable


def test_no_more_buffers_are_kept_than_stated():
    pool = BufferPool("uint8", (1024,), spare=2)
    arrays = [pool.take() for _ in range(5)]
    addresses = {address(array) for array in arrays}
    del arrays
    gc.collect()
    kept = [pool.take() for _ in range(2)]
    assert {address(array) for array in kept} <= addresses
    assert len(pool._free) == 0


def test_a_buffer_outlives_its_pool():
    pool = BufferPool("uint8", (1 << 20,), spare=1)
    array = pool.take()
    array[:] = 5
    del pool
    gc.collect()
    assert (array == 5).all()


LAYOUT = {"voxels": ("int8", (2, 3)), "frames": ("uint8", (5,))}


def shaped(batch_size: int = 4) -> BatchBuffers:
    buffers = BatchBuffers()
    buffers.shape(LAYOUT, batch_size, spare=2)
    return buffers


def sample(value: int) -> dict[str, np.ndarray]:
    return {name: np.full(shape, value, dtype) for name, (dtype, shape) in LAYOUT.items()}


def filled(memory: Memory) -> dict[str, np.ndarray]:
    for row in range(4):
        memory.put(row, sample(row))
    return memory.whole()


def arena_of(memory: SharedMemory) -> str:
    return memory.slot(0).arena


@pytest.mark.parametrize("kind", ["own", "shared"])
def test_a_batch_has_the_rows_that_were_put(kind):
    whole = filled(getattr(shaped(), kind)())
    assert {name: (str(array.dtype), array.shape) for name, array in whole.items()} == {
        "voxels": ("int8", (4, 2, 3)),
        "frames": ("uint8", (4, 5)),
    }
    assert all((array[row] == row).all() for array in whole.values() for row in range(4))


def test_memory_of_another_form_is_let_go():
    buffers = shaped()
    place = address(buffers.own().whole()["voxels"])
    buffers.shape(dict(LAYOUT), 4, spare=2)
    assert address(buffers.own().whole()["voxels"]) == place
    buffers.shape(LAYOUT, 2, spare=2)
    assert buffers.own().whole()["voxels"].shape == (2, 2, 3)


@pytest.mark.parametrize("hold", HOLDS)
def test_an_arena_is_not_used_again_while_anything_looks_at_its_batch(hold):
    buffers = shaped()
    memory = buffers.shared()
    name, whole = arena_of(memory), filled(memory)
    held = hold(whole["voxels"].reshape(4, 6))
    del memory, whole
    gc.collect()
    others = [buffers.shared() for _ in range(3)]
    assert name not in map(arena_of, others)
    del held
    gc.collect()
    assert arena_of(buffers.shared()) == name


def test_an_arena_whose_batch_never_became_whole_is_not_used_again():
    buffers = shaped()
    memory = buffers.shared()
    name = arena_of(memory)
    del memory
    gc.collect()
    assert arena_of(buffers.shared()) != name


@contextmanager
def forked(check):
    """A process that was forked before the block, checks after it, and is to succeed."""
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
def test_an_arena_that_a_forked_process_may_look_at_is_not_used_again():
    buffers = shaped()
    memory = buffers.shared()
    name, mine = arena_of(memory), filled(memory)

    def still_there():
        assert len(mine) == 2
        assert all((array[row] == row).all() for array in mine.values() for row in range(4))

    with forked(still_there):
        mine.clear()
        del memory
        gc.collect()
        for _ in range(3):
            memory = buffers.shared()
            assert arena_of(memory) != name
            memory.put(2, sample(99))
            memory.whole()


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_forked_process_does_not_use_the_arenas_of_its_parent():
    buffers = shaped()
    memory = buffers.shared()
    name = arena_of(memory)
    filled(memory)
    del memory
    gc.collect()

    def uses_another():
        assert arena_of(buffers.shared()) != name

    with forked(uses_another):
        pass
    assert arena_of(buffers.shared()) == name
