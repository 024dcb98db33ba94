"""Dead pixels never fire. They are chosen like the hot ones. No published rate was found."""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_server.simulation import noise
from v2v_server.simulation.effects.state import Clip, hook
from v2v_server.simulation.pixel import PIXELS_A_BLOCK, smallest_words

FIELD, ROWS = "dead_pixel_share", 0
NOISE, PANEL = False, "pixels"
PURPOSES = (PLACE,) = (15,)


def prepare(value: float, clip: Clip) -> tuple[Any, Any]:
    """Return the dead pixels, [count] int64, ascending; and the range of those in the block, [2] int64: start, end."""
    return positions(clip.key, value, clip.pixels), np.zeros(2, np.int64)


def positions(key: noise.NoiseKey, share: float, pixels: int) -> npt.NDArray[np.int64]:
    """Choose the dead pixels, as many as the share states, rounded half up: [count] int64, ascending, in row order."""
    return smallest_words(key, PLACE, math.floor(share * pixels + 0.5), pixels)


@hook
def start(tables, own, block, at):
    """Find the dead pixels of the block."""
    position, of_block = tables
    if len(position) > 0:
        end = 0 if at.first == 0 else of_block[1]
        of_block[0] = end
        while end < len(position) and position[end] < at.first + PIXELS_A_BLOCK:
            end += 1
        of_block[1] = end


@hook
def after(tables, own, block, at):
    """Drop their events."""
    position, of_block = tables
    if len(position) > 0:
        for each in range(of_block[0], of_block[1]):
            place = position[each] - at.first
            block.rises[place] = block.falls[place] = block.tolerance - block.tolerance
