"""Threshold mismatch s: c+ (1 + s z+) and c- (1 + s z-), z Normal(0, 1), once for each pixel and polarity.

No threshold falls below a quarter of the nominal one. Source: Hu et al. 2021, v2e; measured by Lichtsteiner et al.
2008.
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from v2v_protocol.recipe import SMALLEST_THRESHOLD_SHARE
from v2v_server.simulation import noise
from v2v_server.simulation.effects.state import Clip, hook
from v2v_server.simulation.pixel import BLOCK_PX, folds_of, two_normals, word

FIELD, ROWS = "threshold_mismatch_sigma", 0
RADIUS, ANGLE = 9, 10
"""Purposes of the noise's words (``noise.py``)."""
_ONE, _NONE = np.float32(1), np.uint32(0)


class Tables(NamedTuple):
    """Real sigma, and smallest share of the nominal thresholds."""

    sigma: Any
    smallest_share: Any


def prepare(value: float, clip: Clip) -> Tables:
    """Return the tables, see ``effects/__init__.py``."""
    return Tables(clip.real(value), clip.real(SMALLEST_THRESHOLD_SHARE))


def normals(key: noise.NoiseKey, pixels: int) -> tuple[noise.Reals, noise.Reals]:
    """Return each pixel's deviation of its positive and negative threshold, in standard deviations: two of [pixels]
    float32.
    """
    place = np.arange(pixels)
    return noise.box_muller(*noise.mix(noise.words(key, RADIUS, place), noise.words(key, ANGLE, place)))


@hook
def start(tables, own, block, at):
    """Set each pixel's thresholds."""
    if tables.sigma > 0:
        words, normal = block.words, block.floats
        radius, angle = folds_of(block.key, np.uint32(RADIUS)), folds_of(block.key, np.uint32(ANGLE))
        for i in range(BLOCK_PX):
            words[0, i] = word(radius, at.first + i)
            words[1, i] = word(angle, at.first + i)
        two_normals(words[0], words[1], _NONE, _NONE, words[2], words[3], normal[2], normal)
        for i in range(BLOCK_PX):
            block.positive[i] *= max(_ONE + normal[0, i] * tables.sigma, tables.smallest_share)
            block.negative[i] *= max(_ONE + normal[1, i] * tables.sigma, tables.smallest_share)
