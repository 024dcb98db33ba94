"""Inputs of an effect: the clip when its tables are built, the block of pixels and the step when it runs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numba
import numpy as np
import numpy.typing as npt

from v2v_server.simulation import noise
from v2v_server.simulation.precision import Real

_OPTIONS: dict[str, Any] = {
    "nogil": True, "error_model": "numpy", "_nrt": False, "no_cpython_wrapper": True, "no_cfunc_wrapper": True
}  # fmt: skip
compiled: Any = numba.njit(**_OPTIONS)
"""Decorator of a compiled function that only compiled functions call.

It has no reference counting, which every view of an array would cost: it cannot create arrays, and the caller provides
all memory. It has no entry for Python either, because these took a third of the time to compile the kernel. Calling it
from Python ends the process; call its ``py_func`` there, which must call no other such function.
"""
hook: Any = numba.njit(forceinline=True, **_OPTIONS)
"""The same for an effect's functions, which are inlined into the kernel."""


LEGS = 3
"""Parts of a step that an effect divides."""


class Clip(NamedTuple):
    """Inputs of an effect's tables.

    Attributes:
        light: [levels] float64, i(F) of every grey level, 0 (black) to 1 (white); 256 levels for uint8 frames.
        step_seconds: [steps] float64, duration of each step; for an effect, a step is a segment (``voxel.Timeline``).
        durations: [different] float64, the distinct durations, ascending.
        table_of_step: [steps] int64, index into ``durations`` of each step.
        pixels: number of pixels of the picture.
        real: arithmetic of the pixels, float32 or float64.
        key: key of the sample's noise.
        effects: the draw, by field; missing fields are off.
        thresholds: nominal ones, positive and negative, log units.
        first: number of the first step.
    """

    light: npt.NDArray[np.float64]
    step_seconds: npt.NDArray[np.float64]
    durations: npt.NDArray[np.float64]
    table_of_step: npt.NDArray[np.int64]
    pixels: int
    real: Real
    key: noise.NoiseKey
    effects: Mapping[str, float]
    thresholds: tuple[float, float]
    first: int = 0


class Block(NamedTuple):
    """State of PIXELS_A_BLOCK neighbouring pixels; arrays are [PIXELS_A_BLOCK + padding] real unless stated otherwise.

    Attributes:
        residual: remaining change since the last event, log units.
        change: change that this step adds to the residual, log units; of a divided step, that of the leg.
        signed: signed crossings of a threshold in this step or leg.
        rises, falls: its positive and negative events.
        waited, blind: shares of it in which the pixel is blind at its start and after each event.
        timed: whether events need times, and so ``waited`` and ``blind``.
        positive, negative: the thresholds of each pixel, log units.
        levels: rows of log intensity, see :class:`At`.
        words: [4] uint32 rows, and ``floats``: [4] float32 rows, free for use within one call.
        tolerance: real, see ``voxel.py``.
        key: [4] uint32, the noise key.
        legs: [LEGS] rows for a step that is divided, the change of each leg.
        shares: [LEGS] real, their shares of its time.
    """

    residual: Any
    change: Any
    signed: Any
    rises: Any
    falls: Any
    waited: Any
    blind: Any
    timed: Any
    positive: Any
    negative: Any
    levels: Any
    words: Any
    floats: Any
    tolerance: Any
    key: Any
    legs: Any
    shares: Any


class At(NamedTuple):
    """Position of the kernel.

    Attributes:
        first: the block's first pixel.
        step: number of the step: a segment, the whole time from frame to frame or a part of it.
        moved: whether it leads to another frame or intermediate level than the one before.
        before, now: rows of ``Block.levels``: log intensity before and after the step.
        shown: [width] uint8 or uint16, grey levels of the frame at or after its end; narrower than the block at the
            end of the picture.
        share, begun: share of the step's time that the leg takes, and that has passed before it; 1 and 0 for a step in
            one piece.
        is_last: whether it is the step's last leg.
    """

    first: Any
    step: Any
    moved: Any
    before: Any
    now: Any
    shown: Any
    share: Any = 1
    begun: Any = 0
    is_last: Any = True
