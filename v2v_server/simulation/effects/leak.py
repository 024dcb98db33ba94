"""Leak of R events a second: R c+ T of the pixel's own c+ are added to the change of a step of T seconds.

They are positive events. Source: v2e; cause in Nozaki and Delbruck 2017.
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from v2v_server.simulation.effects.state import Clip, hook
from v2v_server.simulation.pixel import BLOCK_PX

FIELD, ROWS = "leak_hz", 0


class Tables(NamedTuple):
    """[steps] real, leak of each step in thresholds; empty for none."""

    leak: Any


def prepare(value: float, clip: Clip) -> Tables:
    """Return the tables, see ``effects/__init__.py``."""
    return Tables((value * clip.step_seconds).astype(clip.real) if value > 0.0 else np.empty(0, clip.real))


@hook
def change(tables, own, block, at):
    """Add the leak."""
    if len(tables.leak) > 0:
        leaked = tables.leak[at.step]
        for i in range(BLOCK_PX):
            block.change[i] += block.positive[i] * leaked
