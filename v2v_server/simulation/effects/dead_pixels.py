"""Dead pixels never fire. They are chosen like the hot ones. No published rate was found."""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from v2v_server.simulation import noise
from v2v_server.simulation.effects.state import Clip, hook
from v2v_server.simulation.pixel import BLOCK_PX

FIELD, ROWS = "dead_pixel_share", 0
PLACE = 15
"""Purpose of the noise's words (``noise.py``)."""


class Tables(NamedTuple):
    """[count] int64, the dead pixels, ascending; [2] int64, range of those in the block: start, end."""

    position: Any
    of_block: Any


def prepare(value: float, clip: Clip) -> Tables:
    """Return the tables, see ``effects/__init__.py``."""
    return Tables(positions(clip.key, value, clip.pixels, clip.words_of), np.zeros(2, np.int64))


def positions(
    key: noise.NoiseKey, share: float, pixels: int, words_of: noise.WordsOf = noise.words
) -> npt.NDArray[np.int64]:
    """Choose the dead pixels, as many as the share states, rounded half up: [count] int64, ascending, in row order."""
    return noise.smallest_words(key, PLACE, math.floor(share * pixels + 0.5), pixels, words_of)


@hook
def start(tables, own, block, at):
    """Find the dead pixels of the block."""
    if len(tables.position) > 0:
        end = 0 if at.first == 0 else tables.of_block[1]
        tables.of_block[0] = end
        while end < len(tables.position) and tables.position[end] < at.first + BLOCK_PX:
            end += 1
        tables.of_block[1] = end


@hook
def after(tables, own, block, at):
    """Drop their events."""
    if len(tables.position) > 0:
        for each in range(tables.of_block[0], tables.of_block[1]):
            place = tables.position[each] - at.first
            block.rises[place] = block.falls[place] = block.tolerance - block.tolerance
