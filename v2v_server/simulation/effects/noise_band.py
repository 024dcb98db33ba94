"""Band-limited noise: stationary noise of S thresholds below a corner of f Hz is added to the log intensity.

The noise x is an Ornstein-Uhlenbeck process of sigma = S (c+ + c-)/2 log units, nominal thresholds, and tau = 1/(2 pi
f). The comparator sees the log intensity with it, and has a memory: a pixel whose level lies between two thresholds
flips between them, so its events alternate. With h = T/tau for a step of T seconds, N standard normals and u uniform:

    x' = rho x + sigma sqrt(1 - rho^2) N,  rho = exp(-h)                 the end of the step, exact; x starts stationary
    E+ = -ln u, E- = -ln(1 - u)                                          one word for both extremes within the step
    h > 1.2:   top = max(x, x', G + sqrt(max(A + B E+, 0)))              A, B, G from :data:`EXTREMES`
    h <= 1.2:  top = (y + sqrt(q + 4 g E+))/2,  y = x + x',  q = (x - x')^2,  in units of sigma:
               g = 1/max(1/H + K m/(2m - y), 1/(5H)),  m = (y + sqrt(q + 4 H E+))/2,  H = sinh h,  K = h/2

and the bottom alike, mirrored, with E-. A, B and G fit P(max < u) = exp(-lambda(u) h)/Phi(u), lambda the slowest rate
at which the process leaves (-inf, u); a Brownian bridge with a pull to zero is the second form. Three straight legs
(:func:`divide`) then pass the comparator: to one extreme, to the other one, to x'. The bridge visits the extreme next
to x first and takes a third of the time for each leg. Else the order is a coin, the first leg ends at a uniform time,
the second in the middle of what is left; a block of pixels shares these times.

Two ranges of h are left out by dividing a step into equal parts (:func:`moments`). With h from 1.2 to 2.4, x and the
extremes depend on each other, and neither form has it. With h above 8, there is time for several excursions each way,
and the law has one. ``python -m bench noise`` compares with the continuous process.
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import MOST_BAND_PARTS
from v2v_server.simulation.effects.state import Clip, compiled, hook
from v2v_server.simulation.intensity import Doubles, exponential, logarithm
from v2v_server.simulation.pixel import PIXELS_A_BLOCK, crossed, folds_of, half_mixed, minus_two_ln, two_normals, word
from v2v_server.simulation.vectors import use_widest_vectors
from v2v_server.simulation.voxel import Moments, Timeline

FIELD, ROWS = "noise_band_share", 3
NOISE, PANEL = True, "still"
PURPOSES = PIXEL_RADIUS, PIXEL_ANGLE, PAIR_RADIUS, PAIR_ANGLE, PIXEL, STEP = range(16, 22)
LONGEST_BRIDGE = 1.2
"""Largest h of the second form."""
LONGEST_BULK = 8.0
"""Largest h of a part, unless a step would need more than MOST_BAND_PARTS."""
EXTREMES = np.array([
    (1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 7.0, 10.0, 14.0, 20.0, 30.0, 45.0, 64.0),
    (-2.7723, -1.9005, -1.3262, -0.9698, -0.7241, -0.5339, -0.4259, -0.2238, -0.0930, -0.0571, -0.0264, 0.0197, 0.1469,
     0.2731),
    (1.7605, 1.9745, 1.9493, 1.9186, 1.8913, 1.7385, 1.6508, 1.6065, 1.5401, 1.4252, 1.3216, 1.2419, 1.2118, 1.1923),
    (0.7760, 0.4740, 0.5014, 0.5451, 0.5886, 0.7863, 0.9185, 1.0267, 1.1710, 1.3691, 1.5628, 1.7422, 1.8503, 1.9310),
])  # fmt: skip
"""h, A, B and G, linear in ln h; beyond the last h, A grows as the largest of several independent steps does."""
_FIFTH, _THIRD, _HALF, _ONE = np.float32(0.2), np.float32(1 / 3), np.float32(0.5), np.float32(1)
_PART = np.float32(1 / 256)


class Tables(NamedTuple):
    """
    Attributes:
        laws: [durations, 6] real, in log units: 1 for the bridge, rho, scale of N, then A, B/2, G or 2 H, 1/H, K; of no
            rows where there is no noise.
        law_of_step: [steps] int64.
        sigma: real, log units.
        words: [3, block] uint32 of the pixels: radius, angle, extremes.
        first: int64, number of the first step.
        is_blind: whether a pixel is blind after an event.
    """

    laws: Any
    law_of_step: Any
    sigma: Any
    words: Any
    first: Any
    is_blind: Any


def prepare(value: float, clip: Clip) -> Tables:
    """Return the tables.

    Raises:
        UsageError: there is no corner.
    """
    corner = clip.effects.get("noise_band_hz", 0.0)
    if value > 0.0 and corner == 0.0:
        raise UsageError(f"noise_band_share = {value:g}: set noise_band_hz, the corner of the noise, too")
    sigma = value * sum(clip.thresholds) / 2.0
    laws = laws_of(2.0 * np.pi * corner * clip.durations, sigma) if value > 0.0 else np.empty((0, 6))
    words, is_blind = np.empty((3, PIXELS_A_BLOCK), np.uint32), clip.effects.get("refractory_seconds", 0.0) > 0.0
    return Tables(laws.astype(clip.real), clip.table_of_step, clip.real(sigma), words, np.int64(clip.first), is_blind)


def moments(whole: Timeline, step_seconds: Doubles, corner_hz: float) -> Moments:
    """Return the moments that divide segments into equal parts, and their starts; for ``step_seconds``, [steps]."""
    h = 2.0 * np.pi * corner_hz * step_seconds[whole.step] * whole.share
    is_between = (h > LONGEST_BRIDGE) & (h <= 2 * LONGEST_BRIDGE)
    parts = np.where(is_between, 2, np.clip(np.ceil(h / LONGEST_BULK), 1, MOST_BAND_PARTS)).astype(np.int64)
    of = np.repeat(np.arange(len(h)), parts)
    passed = (np.arange(len(of)) - np.searchsorted(of, of)) / parts[of]
    return Moments(whole.step[of], whole.start[of] + whole.share[of] * passed)


def laws_of(steps: Doubles, sigma: float) -> Doubles:
    """Return the laws of steps of these h, see :class:`Tables`, [durations, 6] float64, for a noise of sigma."""
    rho = exponential(-steps)
    place, known = logarithm(np.clip(steps, *EXTREMES[0, [0, -1]])), logarithm(EXTREMES[0])
    low = np.minimum(np.searchsorted(known, place, side="right") - 1, len(known) - 2)
    part = (place - known[low]) / (known[low + 1] - known[low])
    a, b, g = EXTREMES[1:, low] + (EXTREMES[1:, low + 1] - EXTREMES[1:, low]) * part
    a += b * (logarithm(np.maximum(steps, EXTREMES[0, -1])) - known[-1])
    is_bridge = steps <= LONGEST_BRIDGE
    sinh = np.where(is_bridge, (1.0 / rho - rho) / 2.0, 1.0)
    extremes = np.where(
        is_bridge, [2.0 * sinh * sigma**2, 1.0 / sinh, steps / 2.0], [a * sigma**2, b * sigma**2 / 2.0, g * sigma]
    )
    return np.stack([is_bridge, rho, sigma * np.sqrt(1.0 - rho * rho), *extremes], axis=1)


@hook
def start(tables, own, block, at):
    """Draw the noise before the first step."""
    if len(tables.laws) > 0:
        radius, angle = folds_of(block.key, PIXEL_RADIUS), folds_of(block.key, PIXEL_ANGLE)
        extremes = folds_of(block.key, PIXEL)
        for i in range(PIXELS_A_BLOCK):
            tables.words[0, i] = word(radius, at.first + i)
            tables.words[1, i] = word(angle, at.first + i)
            tables.words[2, i] = word(extremes, at.first + i)
        _draw(tables, own, block, tables.first // 2)
        for i in range(PIXELS_A_BLOCK):
            own[0, i] = own[1, i] * tables.sigma


@hook
def divide(tables, own, block, at):
    """Divide the step into its three legs; :func:`cross` takes them at once unless events need times or a period."""
    if len(tables.laws) > 0:
        law, number = tables.laws[tables.law_of_step[at.step]], tables.first + at.step + 1
        if number % 2 == 0:
            _draw(tables, own, block, number // 2)
        of_step = word(folds_of(block.key, STEP), number)
        part = (np.float32(np.int32(word((of_step, of_step), at.first) >> np.uint32(24))) + _HALF) * _PART
        part = _THIRD if law[0] > 0 else part
        rest = (_ONE - part) * _HALF
        block.shares[0], block.shares[1], block.shares[2] = part, rest, rest
        _walk(
            law, tables.words[2], of_step, part, rest, own[0], own[1 + number % 2], block.change, block.words[0],
            block.floats[2], block.floats[3], block.legs, tables.sigma,
        )  # fmt: skip
        return block.timed or tables.is_blind
    return False


@hook
def cross(tables, own, block, at):
    """Let a step in one piece pass its legs."""
    is_whole = len(tables.laws) > 0 and not (block.timed or tables.is_blind)
    if is_whole:
        _pass(block.legs, block.residual, block.positive, block.negative, block.rises, block.falls, block.tolerance)
    return is_whole


@hook
def _draw(tables, own, block, pair):
    """Draw two normals of each pixel."""
    words, floats = tables.words, block.floats
    radius, angle = word(folds_of(block.key, PAIR_RADIUS), pair), word(folds_of(block.key, PAIR_ANGLE), pair)
    two_normals(words[0], words[1], radius, angle, block.words[2], block.words[3], floats[2], floats)
    for i in range(PIXELS_A_BLOCK):
        own[1, i], own[2, i] = floats[0, i], floats[1, i]


@compiled
def _walk(law, pixels, of_step, part, rest, x, normal, change, drawn, highs, lows, legs, sigma):
    """Write the legs of a block, and the noise at the step's end into ``x``.

    Args:
        law: [6], see :class:`Tables`.
        pixels, of_step: [block] uint32 and uint32, words of the extremes.
        part, rest: shares of the step that the first leg takes, and each of the others.
        x: [block] real, the noise, log units; ``normal``: [block], the N of this step.
        change: [block] real, what the step adds without the noise.
        drawn, highs, lows: [block] uint32, and float32 twice: working space.
        legs: [3, block] real, written.
        sigma: real.
    """
    use_widest_vectors()  # type: ignore[call-arg]
    is_bridge, rho, scale, a, b, g = law[0] > 0, law[1], law[2], law[3], law[4], law[5]
    zero, tiny = sigma - sigma, sigma * np.float32(1e-6)
    first, second, last = legs[0], legs[1], legs[2]
    # Short loops of few rows each: of more, the compiler cannot tell that they lie apart.
    for i in range(PIXELS_A_BLOCK):
        z = half_mixed(np.uint32(pixels[i] ^ of_step))
        drawn[i] = np.uint32(z ^ (z >> np.uint32(15)))
    for i in range(PIXELS_A_BLOCK):
        highs[i] = minus_two_ln(np.uint32((drawn[i] >> np.uint32(1)) | np.uint32(1)))
        lows[i] = minus_two_ln(np.uint32((~drawn[i] >> np.uint32(1)) | np.uint32(1)))
    for i in range(PIXELS_A_BLOCK):
        last[i] = rho * x[i] + scale * normal[i]
    if is_bridge:
        for i in range(PIXELS_A_BLOCK):
            first[i] = _bridged(x[i] + last[i], x[i] - last[i], highs[i], a, b, g, tiny, sigma)
            second[i] = -_bridged(-(x[i] + last[i]), x[i] - last[i], lows[i], a, b, g, tiny, sigma)
    else:
        for i in range(PIXELS_A_BLOCK):
            first[i] = max(max(x[i], last[i]), g + np.sqrt(max(a + b * highs[i], zero)))
            second[i] = min(min(x[i], last[i]), -g - np.sqrt(max(a + b * lows[i], zero)))
    for i in range(PIXELS_A_BLOCK):
        top, bottom = first[i], second[i]
        rises_first = last[i] < x[i] if is_bridge else (drawn[i] & np.uint32(1)) > 0
        first[i], second[i] = top if rises_first else bottom, bottom if rises_first else top
    for i in range(PIXELS_A_BLOCK):
        before, one, other, after = x[i], first[i], second[i], last[i]
        first[i], x[i] = change[i] * part + (one - before), after
        second[i], last[i] = change[i] * rest + (other - one), change[i] * rest + (after - other)


@hook
def _bridged(y, apart, minus_two_ln_u, twice_h, over_h, k, tiny, sigma):
    """Return the top of a bridge, log units."""
    q = apart * apart
    m = (y + np.sqrt(q + twice_h * minus_two_ln_u)) * _HALF
    slope = max(over_h + k * m / (m + m - y + tiny), over_h * _FIFTH)
    return (y + np.sqrt(q + sigma * sigma / slope * (minus_two_ln_u + minus_two_ln_u))) * _HALF


@compiled
def _pass(legs, residual, positive, negative, rises, falls, tolerance):
    """Let all legs of a block pass the comparator, one after another."""
    use_widest_vectors()  # type: ignore[call-arg]
    first, second, last, zero = legs[0], legs[1], legs[2], tolerance - tolerance
    for i in range(PIXELS_A_BLOCK):
        one, left = crossed(residual[i] + first[i], positive[i], negative[i], tolerance)
        other, left = crossed(left + second[i], positive[i], negative[i], tolerance)
        final, left = crossed(left + last[i], positive[i], negative[i], tolerance)
        rises[i] = max(one, zero) + max(other, zero) + max(final, zero)
        falls[i], residual[i] = rises[i] - (one + other + final), left
