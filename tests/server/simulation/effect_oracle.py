"""Cameras with effects, slowly: float64, one pixel, one step and one event at a time.

Written from the docstrings in ``v2v_server/simulation/effects``, not from the kernel. What is random comes in as an
argument, so that both sides see the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Doubles = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """Units as in ``v2v_protocol.recipe``; thresholds are nominal, log units."""

    threshold_pos: float
    threshold_neg: float
    tolerance: float
    threshold_mismatch_sigma: float = 0.0
    shot_noise_hz: float = 0.0
    leak_hz: float = 0.0
    refractory_seconds: float = 0.0
    photoreceptor_hz: float = 0.0


@dataclass(frozen=True)
class Chance:
    """What is random.

    Attributes:
        start: [pixels] uniform in [0, 1): where the residual starts between the pixel's thresholds.
        change: [steps, pixels] noise and hot drift, log units.
        mismatch: [2, pixels] standard normals of the positive and the negative threshold.
        shot: [2, steps, pixels] uniform in [0, 1), of the positive and the negative events.
        dead: positions of dead pixels.
    """

    start: Doubles
    change: Doubles
    mismatch: Doubles
    shot: Doubles
    dead: npt.NDArray[np.int64]


def simulate(
    grey: npt.NDArray[np.uint8], seconds: Doubles, gamma: float, log_eps: float, camera: Camera, chance: Chance
) -> Doubles:
    """Signed events of every step: [steps, pixels].

    Args:
        grey: [steps + 1, pixels].
        seconds: [steps] duration of each step.
    """
    steps, pixels = chance.change.shape
    counts = np.zeros((steps, pixels))
    for p in range(pixels):
        if p in chance.dead:
            continue
        light = [(int(level) / 255) ** gamma for level in grey[:, p]]
        level = [math.log(log_eps + each) for each in light]
        positive = camera.threshold_pos * max(1 + camera.threshold_mismatch_sigma * float(chance.mismatch[0, p]), 0.25)
        negative = camera.threshold_neg * max(1 + camera.threshold_mismatch_sigma * float(chance.mismatch[1, p]), 0.25)
        residual = -negative + float(chance.start[p]) * (positive + negative)
        seen, blind = level[0], 0.0
        for step in range(steps):
            duration = float(seconds[step])
            after = filtered(camera.photoreceptor_hz, light[step + 1], seen, level[step], level[step + 1], duration)
            change = after - seen + float(chance.change[step, p]) + camera.leak_hz * positive * duration
            seen = after
            counts[step, p], residual, blind = fire(
                residual, blind, change, duration, positive, negative, camera.refractory_seconds, camera.tolerance
            )
            if camera.shot_noise_hz > 0:
                mean = 0.5 * camera.shot_noise_hz * duration * (1 - 0.75 * light[step + 1])
                rising, falling = (poisson(float(chance.shot[sign, step, p]), mean) for sign in (0, 1))
                counts[step, p] += rising - falling
                residual = 0.0 if rising or falling else residual
    return counts


def filtered(white_hz: float, light: float, seen: float, level: float, next_level: float, seconds: float) -> float:
    """dP/dt = 2 pi f (L - P) for L that goes linearly from ``level`` to ``next_level``, solved.

    The particular solution is L lagging by 1 / (2 pi f); what P differs from it at the start decays.
    """
    if white_hz == 0:
        return next_level
    rate = 2 * math.pi * white_hz * (light + 20 / 255) / (1 + 20 / 255)
    lag = (next_level - level) / (seconds * rate)
    return (next_level - lag) + (seen - (level - lag)) * math.exp(-rate * seconds)


def fire(
    residual: float, blind: float, change: float, seconds: float, positive: float, negative: float, refractory: float,
    tolerance: float,
) -> tuple[int, float, float]:  # fmt: skip
    """Event by event: signed events, residual and blind seconds at the end of a step of linear change."""
    now, events = min(blind, seconds), 0
    blind -= now
    slope = change / seconds
    while now < seconds:
        reached = residual + slope * (seconds - now)
        sign = 1 if reached >= 0 else -1
        threshold = positive if sign > 0 else negative
        if abs(reached) + tolerance < threshold:
            return events, reached, 0.0
        events += sign
        if slope == 0:
            residual = reached - sign * threshold
            continue
        now += (threshold - sign * residual) / abs(slope) + refractory
        residual = 0.0
        if now > seconds:
            # The rest of the blind time; an event that only the tolerance brought about may leave a rounding.
            blind = min(now - seconds, refractory)
    return events, residual, blind


def poisson(uniform: float, mean: float) -> int:
    """How many events: the smallest k for which the chance of more than k is no more than ``uniform``."""
    count, term = 0, math.exp(-mean)
    below = term
    while uniform < 1 - below:
        count += 1
        term *= mean / count
        below += term
    return count
