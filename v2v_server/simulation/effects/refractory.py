"""Refractory period t: for t seconds after an event a pixel fires none, and changes in that time are lost.

v2e drops the events of that time. With a change that is linear within the step, k events take the time to the first
threshold plus (k - 1) (c / slope + t), and the remaining blind time continues in the next step.
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from typing import Any

import numba
import numpy as np

from v2v_server.simulation.effects.state import Clip, hook
from v2v_server.simulation.pixel import PIXELS_A_BLOCK

FIELD, ROWS = "refractory_seconds", 1
NOISE, PANEL = False, "intervals"


def prepare(value: float, clip: Clip) -> tuple[Any, Any]:
    """Return the period, real, and the duration of each step, [steps] real."""
    return clip.real(value), clip.step_seconds.astype(clip.real)


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
        duration, blind, zero = seconds[at.step] * at.share, own[0], block.tolerance - block.tolerance
        if block.timed:
            for i in range(PIXELS_A_BLOCK):
                block.waited[i], block.blind[i] = blind[i] / duration, refractory / duration
        for i in range(PIXELS_A_BLOCK):
            block.signed[i], block.residual[i], blind[i] = crossed(
                block.residual[i], blind[i], block.change[i], duration, refractory, block.positive[i],
                block.negative[i], block.tolerance,
            )  # fmt: skip
        for i in range(PIXELS_A_BLOCK):
            block.rises[i], block.falls[i] = max(block.signed[i], zero), max(zero - block.signed[i], zero)
        return True
    return False
