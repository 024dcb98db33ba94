"""Threshold mismatch s: c+ (1 + s z+) and c- (1 + s z-), z Normal(0, 1), once for each pixel and polarity.

No threshold falls below a quarter of the nominal one. Source: Hu et al. 2021, v2e; measured by Lichtsteiner et al.
2008.
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from typing import Any

import numpy as np

from v2v_protocol.recipe import SMALLEST_THRESHOLD_SHARE
from v2v_server.simulation.effects.state import Clip, hook
from v2v_server.simulation.pixel import PIXELS_A_BLOCK, folds_of, two_normals, word

FIELD, ROWS = "threshold_mismatch_sigma", 0
NOISE, PANEL = False, "pixels"
PURPOSES = RADIUS, ANGLE = 9, 10
_ONE, _NONE = np.float32(1), np.uint32(0)


def prepare(value: float, clip: Clip) -> tuple[Any, Any]:
    """Return sigma, and the smallest share of the nominal thresholds."""
    return clip.real(value), clip.real(SMALLEST_THRESHOLD_SHARE)


@hook
def start(tables, own, block, at):
    """Set each pixel's thresholds."""
    sigma, smallest_share = tables
    if sigma > 0:
        words, normal = block.words, block.floats
        radius, angle = folds_of(block.key, RADIUS), folds_of(block.key, ANGLE)
        for i in range(PIXELS_A_BLOCK):
            words[0, i] = word(radius, at.first + i)
            words[1, i] = word(angle, at.first + i)
        two_normals(words[0], words[1], _NONE, _NONE, words[2], words[3], normal[2], normal)
        for i in range(PIXELS_A_BLOCK):
            block.positive[i] *= max(_ONE + normal[0, i] * sigma, smallest_share)
            block.negative[i] *= max(_ONE + normal[1, i] * sigma, smallest_share)
