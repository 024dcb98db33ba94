"""Arrays made of events: one file per representation, named as its array.

    voxels.py           signed counts of each bin
    event_counts.py     counts of each bin and polarity
    voxels_bilinear.py  each event shared between the two bins next to its time
    time_surface.py     age of the last event of each polarity at the end of each bin
    listing.py          the events one by one, which are no array of a sample

A representation is one line of ``v2v_protocol.sample.ARRAYS`` (its form, by ``of_events``) and one file here, with
compiled functions. It has some of these, and each does nothing if the array has no rows:

    begin(tables, first)     before the first step of a block of pixels; the first of them
    events(tables, train)    what events of a pixel do (:class:`Train`); the kernel then gives every event its time
    end(tables, counts)      at the end of a bin (:class:`Counts`)

They return how many values did not fit, allocate no memory and use no maths library. The tables are the memory of the
array, of no rows if it is not wanted, with height and width as one axis if the array ends with them; or what this
function of the file returns, of the same types in both cases:

    prepare(memory, given, segments, real)

It gets the clip (``kernels.KernelInput``), its segments (``voxel.Timeline``) and the arithmetic, float32 or float64. In
the place of float16 the memory is float32, and is clipped to float16 at the end. ``docs/extending.md`` shows how to add
a representation.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from v2v_protocol.sample import ARRAYS

_LARGEST_FLOAT16 = 65504.0


class Train(NamedTuple):
    """Events of one pixel and polarity in one segment, at equal distances in time.

    Attributes:
        pixel: of the picture; ``place``: of the block.
        segment: number of the segment.
        is_rising: 1 for positive events, 0 for negative ones.
        passed: float64, share of the segment's time that has passed at the first of them.
        apart: float64, share between two of them.
        count: number of them, at least 1.
    """

    pixel: Any
    place: Any
    segment: Any
    is_rising: Any
    passed: Any
    apart: Any
    count: Any


class Counts(NamedTuple):
    """Events of a block of pixels in the bin that ends.

    Attributes:
        first, last: the first pixel of the block, and the one after the last.
        grid, bin: number of the voxel grid, and of the bin in it.
        limit: real, largest count that the dtype of the voxels stores.
        net, on, off: [block] real, signed, positive and negative events. Only ``net`` is set if nothing but voxels is
            made.
    """

    first: Any
    last: Any
    grid: Any
    bin: Any
    limit: Any
    net: Any
    on: Any
    off: Any


NAMES = tuple(name for name, form in ARRAYS.items() if form.of_events is not None)
"""Names of the arrays."""
REPRESENTATIONS = {name: import_module(f"{__name__}.{name}") for name in (*NAMES, "listing")}


def has_pixels(name: str) -> bool:
    """Return whether an array has a value for each pixel: its shape ends with height and width."""
    shape = ARRAYS[name].of_events
    return shape is not None and shape("int8", 5, 7, 11, 13)[1][-2:] == (11, 13)


def new_memory(name: str, array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return what the kernel writes in the place of an array [..., H, W]: [..., pixels]; or the array's own shape, if
    it has no pixels.
    """
    shape = (*array.shape[:-2], array.shape[-2] * array.shape[-1]) if has_pixels(name) else array.shape
    return np.empty(shape, np.float32) if array.dtype == np.float16 else array.reshape(shape)


def fill_array(array: npt.NDArray[Any], memory: npt.NDArray[Any]) -> int:
    """Fill an array, [T, ..., H, W] or [T, ...], from the memory that the kernel wrote; return how many values were
    clipped.
    """
    if array.dtype != np.float16:
        return 0
    within = np.clip(memory, -_LARGEST_FLOAT16, _LARGEST_FLOAT16)
    np.copyto(within, memory, where=np.isinf(memory))
    array[...] = within.reshape(array.shape)
    return int(np.count_nonzero(within != memory))
