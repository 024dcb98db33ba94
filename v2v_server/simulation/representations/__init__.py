"""Arrays made of events: one file per representation, named as its array.

    voxels.py           signed counts of each bin
    event_counts.py     counts of each bin and polarity
    voxels_bilinear.py  each event shared between the two bins next to its time
    time_surface.py     age of the last event of each polarity at the end of each bin
    listing.py          the events one by one, which are no array of a sample

A representation is one line of ``v2v_protocol.sample.ARRAYS`` (its form, as ``OfEvents``) and one file here. The file
states

    prepare(array, clip)    its tables, among them the memory that the kernel writes; for None, which switches it off,
                            they have the same types
    finish(tables, array)   complete the array from that memory; return how many values did not fit its dtype

and, compiled, any of these functions. Each does nothing if the tables say off:

    begin(tables, block)    before the first step of a block of pixels (:class:`Pixels`)
    events(tables, train)   what events of a pixel do (:class:`Train`); it makes the kernel give every event its time
    end(tables, counts)     at the end of a bin (:class:`Counts`)

They allocate no memory and use no maths library. ``docs/extending.md`` shows how to add a representation.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from v2v_protocol.sample import ARRAYS, OfEvents
from v2v_server.simulation.precision import Real
from v2v_server.simulation.voxel import LARGEST_COUNT, Doubles, Moments, Timeline


class Clip(NamedTuple):
    """Inputs of a representation's tables.

    Attributes:
        segments: of the clip.
        edges: ends of the bins, the clip's start included.
        step_seconds: [steps] duration of each step.
        bins: bins of a voxel grid.
        pixels: number of pixels of the picture.
        dtype: of the voxels, "int8", "int16" or "float32".
        real: arithmetic of the pixels, float32 or float64.
    """

    segments: Timeline
    edges: Moments
    step_seconds: Doubles
    bins: int
    pixels: int
    dtype: str
    real: Real

    @property
    def limit(self) -> np.floating[Any]:
        """Return the largest count that the dtype stores."""
        return self.real(LARGEST_COUNT[self.dtype])

    def memory(self, array: npt.NDArray[Any] | None, dtype: str, *axes: int) -> npt.NDArray[Any]:
        """Return an array as the kernel writes it, [n, *axes, pixels]; of no rows if it is None."""
        return np.empty((0, *axes, self.pixels), dtype) if array is None else array.reshape(-1, *axes, self.pixels)


class Pixels(NamedTuple):
    """A block of pixels: the first one, and the one after the last."""

    first: Any
    last: Any


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
        bin: number of the bin in the clip.
        net, on, off: [block] real, signed, positive and negative events. Only ``net`` is set if nothing but voxels is
            made.
    """

    first: Any
    last: Any
    bin: Any
    net: Any
    on: Any
    off: Any


NAMES = tuple(name for name, form in ARRAYS.items() if isinstance(form, OfEvents))
"""Names of the arrays."""
REPRESENTATIONS = {name: import_module(f"{__name__}.{name}") for name in (*NAMES, "listing")}


def prepare(arrays: Mapping[str, npt.NDArray[Any]], clip: Clip) -> tuple[Any, ...]:
    """Return the tables of every representation for one clip, in the order of :data:`REPRESENTATIONS`.

    Args:
        arrays: those to make, by name, C-contiguous; the others are off.
        clip: the clip.
    """
    return tuple(each.prepare(arrays.get(name), clip) for name, each in REPRESENTATIONS.items())


def finish(arrays: Mapping[str, npt.NDArray[Any]], tables: tuple[Any, ...]) -> dict[str, int]:
    """Complete the arrays that the kernel has made; return how many values of each did not fit its dtype."""
    made = zip(REPRESENTATIONS.items(), tables, strict=True)
    return {name: each.finish(own, arrays[name]) for (name, each), own in made if name in arrays}
