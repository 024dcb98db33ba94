"""Refractory period t: for t seconds after an event a pixel fires none, and changes in that time are lost.

v2e drops the events of that time. With a change that is linear within the step, k events take the time to the first
threshold plus (k - 1) (c / slope + t), and the remaining blind time continues in the next step.
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from typing import Any

import numba
import numpy as np

from v2v_server.simulation.effects.state import UNITS, Clip, Fired, hook
from v2v_server.simulation.pixel import PIXELS_A_BLOCK

FIELD, ROWS = "refractory_seconds", 1
NOISE, PANEL = False, "intervals"
COST, MARGIN = 8, 4.0


def prepare(value: float, clip: Clip) -> tuple[Any, Any]:
    """Return the period, real, and the duration of each step, [steps] real."""
    return clip.real(value), clip.step_seconds.astype(clip.real)


def changed(value: float, fired: Fired) -> float:
    """Return what is lost, sum n |dL| / c x t / T, and 2 |what was lost before, rising less falling| in each step with
    events, n; and what noise and hot drift lose.
    """
    lost = np.rint((fired.events * fired.change).astype(np.float64) * (value * fired.pace)[:, None]).astype(np.int64)
    before = np.abs(np.cumsum(lost, axis=0) - lost)
    changed = np.abs(lost) + 2 * np.minimum(before, UNITS) * (fired.events != 0)
    return float(int(changed.sum()) / UNITS + fired.grey.shape[1] * fired.noise_events(value))


@numba.njit(nogil=True, error_model="numpy")
def crossed(residual, blind, change, seconds, refractory, threshold_pos, threshold_neg, tolerance):
    """Return signed events, residual and blind seconds after a step whose change is linear in time.

    In log units, a period between events is the threshold plus the change during the blind time.
    """
    zero = tolerance - tolerance
    seen = max(seconds - blind, zero) / seconds
    potential = residual + change * seen
    rising = potential >= zero
    threshold = threshold_pos if rising else threshold_neg
    size, speed = abs(potential), abs(change)
    missed = speed * (refractory / seconds)
    period = threshold + missed
    more = np.floor((size - threshold + tolerance) / period)
    left = (size - threshold) - more * period
    fires = size + tolerance >= threshold
    is_blind = left < missed
    events = more + np.float32(1) if fires else zero
    blind_left = max(blind - seconds, zero)
    blind_after = min(refractory - left * (seconds / speed), refractory) if is_blind else zero
    size_after = zero if is_blind else left - missed
    signed_after = size_after if rising else -size_after
    return (
        events if rising else zero - events,
        signed_after if fires else potential,
        blind_after if fires else blind_left,
    )


@hook
def start(tables, own, block, at):
    """Reset the blind time."""
    for i in range(PIXELS_A_BLOCK):
        own[0, i] = block.tolerance - block.tolerance


@hook
def cross(tables, own, block, at):
    """Fire events one after another in time."""
    refractory, seconds = tables
    if refractory > 0:
        duration, blind = seconds[at.step], own[0]
        if block.timed:
            for i in range(PIXELS_A_BLOCK):
                block.waited[i], block.blind[i] = blind[i] / duration, refractory / duration
        for i in range(PIXELS_A_BLOCK):
            block.signed[i], block.residual[i], blind[i] = crossed(
                block.residual[i], blind[i], block.change[i], duration, refractory, block.positive[i],
                block.negative[i], block.tolerance,
            )  # fmt: skip
        return True
    return False
