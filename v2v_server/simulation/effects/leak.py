"""Leak of R events a second: R c+ T of the pixel's own c+ are added to the change of a step of T seconds.

They are positive events. Source: v2e; cause in Nozaki and Delbruck 2017.
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_server.simulation.effects.state import Clip, hook
from v2v_server.simulation.pixel import PIXELS_A_BLOCK

FIELD, ROWS = "leak_hz", 0
NOISE, PANEL = True, "still"


def prepare(value: float, clip: Clip) -> npt.NDArray[Any]:
    """Return the leak of each step in thresholds, [steps] real; empty for none."""
    return (value * clip.step_seconds).astype(clip.real) if value > 0.0 else np.empty(0, clip.real)


@hook
def change(leak, own, block, at):
    """Add the leak."""
    if len(leak) > 0:
        leaked = leak[at.step]
        for i in range(PIXELS_A_BLOCK):
            block.change[i] += block.positive[i] * leaked
