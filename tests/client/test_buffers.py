import gc

import numpy as np
import pytest
import torch

from v2v_client.buffers import BatchBuffers, BufferPool


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


def test_batches_of_another_form_get_other_memory():
    buffers, layout = BatchBuffers(), {"voxels": ("int8", (2, 3)), "frames": ("uint8", (5,))}
    buffers.shape(layout, 4, spare=1)
    first = buffers.take()
    assert {name: (str(array.dtype), array.shape) for name, array in first.items()} == {
        "voxels": ("int8", (4, 2, 3)),
        "frames": ("uint8", (4, 5)),
    }
    place = address(first["voxels"])
    del first
    buffers.shape(dict(layout), 4, spare=1)
    again = buffers.take()
    assert address(again["voxels"]) == place
    buffers.shape(layout, 2, spare=1)
    assert buffers.take()["voxels"].shape == (2, 2, 3)
