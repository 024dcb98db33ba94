"""Photoreceptor low-pass of f_white Hz: dP/dt = 2 pi f (L - P), f = f_white (i + 20/255) / (1 + 20/255).

i is the light of the new frame (v2e). L is linear between frames (ESIM: Rebecq et al. 2018), for which P after a step
of T seconds is exact, however bins divide the step:

    P' = P + a (L - P) + b (L' - L),    a = 1 - exp(-2 pi f T),    b = 1 - a / (2 pi f T)

P takes the place of L in all that follows. It starts settled. Within a segment (``voxel.py``) P bends, but its events
are those of the net change, at even distances. Where P turns in a segment, events are missed; more bins miss fewer
(``python -m bench physics``).
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from typing import Any

import numpy as np

from v2v_server.simulation.effects.state import Clip, hook
from v2v_server.simulation.intensity import Doubles, exponential
from v2v_server.simulation.pixel import PIXELS_A_BLOCK, look_up

FIELD, ROWS = "photoreceptor_hz", 3
NOISE, PANEL = False, "rates"
DARKEST = 20 / 255
"""v2e's offset of the light that sets the bandwidth: no pixel is slower than 1/14 of a white one."""


def prepare(value: float, clip: Clip) -> tuple[Any, Any]:
    """Return a and b by grey level, real [tables, 2, levels], no table without low-pass; and which a step has."""
    durations = clip.durations if value > 0.0 else clip.durations[:0]
    return low_pass_tables(value, clip.light, durations).astype(clip.real), clip.table_of_step


def low_pass_tables(photoreceptor_hz: float, light: Doubles, seconds: Doubles) -> Doubles:
    """Return a and b of steps of these durations, [durations, 2, levels] float64."""
    turns = (2.0 * np.pi * photoreceptor_hz * seconds)[:, None] * ((light + DARKEST) / (1.0 + DARKEST))
    a = 1.0 - exponential(-turns)
    return np.stack([a, 1.0 - a / turns], axis=1)


@hook
def start(tables, own, block, at):
    """Set P = L."""
    if len(tables[0]) > 0:
        for i in range(PIXELS_A_BLOCK):
            own[0, i] = block.levels[at.now, i]


@hook
def see(tables, own, block, at):
    """Replace the change by that of P."""
    low_pass, table_of_step = tables
    if len(low_pass) > 0:
        seen, slow, fast, levels = own[0], own[1], own[2], block.levels
        of_step = table_of_step[at.step]
        if at.moved or at.step == 0 or of_step != table_of_step[at.step - 1]:
            look_up(low_pass[of_step, 0], at.shown, at.shown, slow)
            look_up(low_pass[of_step, 1], at.shown, at.shown, fast)
        for i in range(PIXELS_A_BLOCK):
            old, new = levels[at.before, i], levels[at.now, i]
            block.change[i] = slow[i] * (old - seen[i]) + fast[i] * (new - old)
            seen[i] += block.change[i]
