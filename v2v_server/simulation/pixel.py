"""The fused pixel kernel: frames in, voxels out, one pass.

Pixels are independent, so the loop over time runs inside a loop over blocks of neighbouring pixels whose state stays
in the cache. Within a step, noise, look-up and threshold are separate short loops over the block, each simple enough
that the compiler turns it into vector instructions; one loop that did everything would not be.

Bit for bit the arithmetic is that of ``noise.py`` and ``voxel.py``: no fast-math, no contraction to fused multiply-add,
no maths library (square root and floor are exact operations of IEEE 754), explicit 32-bit types throughout. So the
instruction set changes the speed, never a bit.
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from functools import lru_cache
from typing import Any

import numba
import numpy as np
import numpy.typing as npt
from numba.core import types
from numba.extending import overload

from v2v_server.simulation import noise
from v2v_server.simulation.vectors import (
    aligned_rows,
    bits_of_float,
    float_of_bits,
    look_up_by_permutation,
    use_widest_vectors,
)

PIXELS_A_BLOCK = 512
"""Pixels of a block. Smaller blocks touch each page of frames and voxels more often; larger ones exceed the cache."""

PITCH = PIXELS_A_BLOCK + 16  # rows a multiple of 4096 bytes apart would alias in the processor's store buffer
ROWS_AHEAD = 3  # number of steps that a row of frames is prefetched before its use

_S0, _S1, _S2 = noise.SCRAMBLE_FACTORS
_M0, _M1, _M2 = noise.MIX_FACTORS
_L0, _L1, _L2, _L3, _L4 = noise.LOG_COEFFICIENTS
_A0, _A1, _A2, _A3 = noise.SIN_COEFFICIENTS
_C0, _C1, _C2, _C3 = noise.COS_COEFFICIENTS
_ONE, _TURN, _UNIT = np.float32(1), np.float32(2.0**-32), np.float32(2.0**-24)
_LOW_31_BITS = np.uint32(0x7FFFFFFF)


def _log_intensity(table, value):
    """Return log intensities: grey levels go through the table, floating point values are log intensities already."""
    raise NotImplementedError("compiled code only")


@overload(_log_intensity)
def _overload_log_intensity(table, value):
    if isinstance(value, types.Integer):
        return lambda table, value: table[value]
    return lambda table, value: value


@numba.njit(nogil=True)
def _scramble(x):
    x = np.uint32(x ^ (x >> np.uint32(17)))
    x = np.uint32(x * _S0)
    x = np.uint32(x ^ (x >> np.uint32(11)))
    x = np.uint32(x * _S1)
    x = np.uint32(x ^ (x >> np.uint32(15)))
    x = np.uint32(x * _S2)
    return np.uint32(x ^ (x >> np.uint32(14)))


@numba.njit(nogil=True)
def _fold(key, constant):
    word = _scramble(np.uint32(constant * noise.GOLDEN))
    word = _scramble(np.uint32(word + key[0]))
    word = _scramble(np.uint32(word + key[1]))
    word = _scramble(np.uint32(word + key[2]))
    return _scramble(np.uint32(word + key[3]))


@numba.njit(nogil=True)
def folds_of(key, purpose):
    """Return the key's two words of a purpose, a whole number (``noise.py``)."""
    return _fold(key, np.uint32(2 * purpose)), _fold(key, np.uint32(2 * purpose + 1))


@numba.njit(nogil=True)
def word(folds, counter):
    return _scramble(np.uint32(_scramble(np.uint32(np.uint32(counter) + folds[0])) + folds[1]))


@numba.njit(nogil=True, cache=True)
def words(key, purpose, counters):
    """Return the words of a purpose (``noise.py``).

    Args:
        key: four words, 0 .. 2**32 - 1.
        purpose: a constant of ``noise.py``.
        counters: [count] int64, 0 .. 2**32 - 1.

    Returns:
        [count] uint32.
    """
    found = np.empty(len(counters), np.uint32)
    folds = folds_of((np.uint32(key[0]), np.uint32(key[1]), np.uint32(key[2]), np.uint32(key[3])), purpose)
    for i in range(len(counters)):
        found[i] = word(folds, counters[i])
    return found


def hot_pixels(key: noise.NoiseKey, count: int, pixels: int) -> tuple[npt.NDArray[np.int64], noise.Reals]:
    """Choose the hot pixels: those of the smallest words, so they are distinct for any count up to all.

    Args:
        count: number of hot pixels, 0 .. pixels.

    Returns:
        positions [count] int64, ascending, in row order; their standard normals [count] float32.
    """
    position = smallest_words(key, noise.HOT_PLACE, count, pixels)
    normal, _ = noise.box_muller(words(key, noise.HOT_RADIUS, position), words(key, noise.HOT_ANGLE, position))
    return position, normal


@lru_cache(maxsize=4)  # each piece of a long clip asks again
def smallest_words(key: noise.NoiseKey, purpose: int, count: int, pixels: int) -> npt.NDArray[np.int64]:
    """Return the pixels that have the smallest words: [count] int64, ascending, in row order; not to be changed."""
    if count == 0:
        return np.empty(0, np.int64)
    place_words = words(key, purpose, np.arange(pixels))
    largest = np.partition(place_words, count - 1)[count - 1]
    return np.flatnonzero(place_words <= largest).astype(np.int64)


@numba.njit(nogil=True)
def minus_two_ln(word):
    """Return -2 ln (word / 2**31) of a word, uint32, 1 to 2**31 - 1: float32 (``noise.py``)."""
    bits: Any = bits_of_float(np.float32(np.int32(word)))  # type: ignore[call-arg]
    exponent = np.int32(np.int32(bits - noise.SQRT_HALF_BITS) >> np.int32(23))
    fraction = float_of_bits(np.int32(bits - np.int32(exponent << np.int32(23)))) - _ONE
    square = fraction * fraction
    high = (_L2 + _L3 * fraction) + _L4 * square
    log = np.float32(np.int32(exponent - np.int32(31))) * noise.MINUS_2_LN_2
    return log + fraction * ((_L0 + _L1 * fraction) + high * square)


@numba.njit(nogil=True)
def half_mixed(x):
    """Return the first half of ``noise.mix`` of a word, uint32."""
    x = np.uint32(x ^ (x >> np.uint32(16)))
    x = np.uint32(x * _M0)
    x = np.uint32(x ^ (x >> np.uint32(15)))
    return np.uint32(x * _M1)


@numba.njit(nogil=True, inline="always")
def two_normals(radius_words, angle_words, radius_word, angle_word, x_row, y_row, radius_row, normal):
    """Write ``noise.mix`` and ``noise.box_muller`` of a block to ``normal`` [2, block], using the three other rows.

    Several short loops: a processor overlaps iterations only within its window of waiting instructions, and a long
    chain of dependent operations fills that window with a single iteration.
    """
    for i in range(PIXELS_A_BLOCK):
        x = half_mixed(np.uint32(radius_words[i] ^ radius_word))
        y = np.uint32(np.uint32(x ^ (x >> np.uint32(15))) ^ np.uint32(angle_words[i] ^ angle_word))
        x_row[i] = np.uint32((x & _LOW_31_BITS) | np.uint32(1))
        y_row[i] = np.uint32(y * _M2)
    for i in range(PIXELS_A_BLOCK):
        bits: Any = bits_of_float(np.float32(np.int32(x_row[i])))  # type: ignore[call-arg]
        exponent = np.int32(np.int32(bits - noise.SQRT_HALF_BITS) >> np.int32(23))
        normal[0, i] = float_of_bits(np.int32(bits - np.int32(exponent << np.int32(23)))) - _ONE
        normal[1, i] = np.float32(np.int32(exponent - np.int32(31))) * noise.MINUS_2_LN_2
    for i in range(PIXELS_A_BLOCK):
        fraction = normal[0, i]
        square = fraction * fraction
        high = (_L2 + _L3 * fraction) + _L4 * square
        radius_row[i] = np.sqrt(normal[1, i] + fraction * ((_L0 + _L1 * fraction) + high * square))
    for i in range(PIXELS_A_BLOCK):
        turn = np.float32(np.int32(y_row[i])) * _TURN
        square = turn * turn
        fourth = square * square
        normal[0, i] = turn * ((_A0 + _A1 * square) + (_A2 + _A3 * square) * fourth)
        normal[1, i] = (_C0 + _C1 * square) + (_C2 + _C3 * square) * fourth
    for i in range(PIXELS_A_BLOCK):
        sine, cosine = normal[0, i], normal[1, i]
        twice = sine + sine
        normal[0, i] = radius_row[i] * (_ONE - twice * sine)
        normal[1, i] = radius_row[i] * (twice * cosine)


@numba.njit(nogil=True, inline="always")
def look_up(table, row, coming, levels):
    for i in range(look_up_by_permutation(table, row, coming, levels), len(row)):  # type: ignore[call-arg]
        levels[i] = _log_intensity(table, row[i])


@numba.njit(nogil=True, error_model="numpy")
def crossed(potential, threshold_pos, threshold_neg, tolerance):
    """Return the signed events of a potential, and the residual they leave: the rule of ``voxel.py``. No event is
    +0, never -0.
    """
    zero = tolerance - tolerance
    rising = potential >= zero
    threshold = threshold_pos if rising else threshold_neg
    events = np.floor((abs(potential) + tolerance) / threshold)
    signed = events if rising else zero - events
    return signed, potential - signed * threshold


@numba.njit(nogil=True, inline="always")
def triangular(uniform, threshold_pos, threshold_neg):
    """Return the residual at the start of a clip, drawn from the triangular law by u in [0, 1). With s = c+ + c-:

        r = -c- + sqrt(u s c-)        if u s < c-
        r =  c+ - sqrt((1 - u) s c+)  otherwise

    Its density is 2/s (1 - r/c+) above 0 and 2/s (1 + r/c-) below: where a residual that moves as a Brownian motion
    and returns to 0 at each event stands in the long run.
    """
    span = threshold_pos + threshold_neg
    if uniform * span < threshold_neg:
        return np.sqrt(uniform * span * threshold_neg) - threshold_neg
    return threshold_pos - np.sqrt((_ONE - uniform) * span * threshold_pos)


@numba.njit(nogil=True, inline="always")
def store(counts, limit, stored):
    """Store one bin of each pixel in the voxels; return how many had to be clipped."""
    exceeded = False
    for i in range(len(stored)):
        exceeded |= abs(counts[i]) > limit
        stored[i] = counts[i]
    if exceeded:
        return _store_clipped(counts, limit, stored)
    return 0


@numba.njit(nogil=True, inline="always")
def _store_clipped(counts, limit, stored):
    clipped = 0
    for i in range(len(stored)):
        clipped += abs(counts[i]) > limit
        stored[i] = min(max(counts[i], -limit), limit)
    return clipped


@numba.njit(nogil=True, cache=True, error_model="numpy")
def simulate_pixels(
    frames, table, source_index, key, noise_scale, hot_position, hot_drift, hot_scale,
    threshold_pos, threshold_neg, tolerance, start_low, start_span, is_triangular, steps_per_bin, limit, voxels,
):  # fmt: skip
    """Simulate every pixel of a clip. ``real`` below is float32 or float64, one for all.

    Args:
        frames: [n, pixels] uint8 or uint16 grey levels, or real log intensities; C-contiguous.
        table: [levels] real, log intensity of each grey level; 256 levels for uint8.
        source_index: [steps + 1] int64, the row of ``frames`` each position shows; never decreasing.
        key: [4] uint32, the noise key.
        noise_scale: [steps] real, standard deviation of each step's noise; empty for no noise at all.
        hot_position: [count] int64, ascending.
        hot_drift: [count] real, drift per unit of ``hot_scale``.
        hot_scale: [steps] real.
        threshold_pos, threshold_neg, tolerance: real, log units (``voxel.py``).
        start_low, start_span: real, the residual starts uniformly in [low, low + span), log units.
        is_triangular: True draws it from the triangular law between the thresholds instead.
        steps_per_bin: frames_per_bin.
        limit: real, largest count the dtype of ``voxels`` stores.
        voxels: [steps / steps_per_bin, pixels], written.

    Returns:
        number of bins clipped to the limit.
    """
    use_widest_vectors()  # type: ignore[call-arg]
    steps, pixels = len(source_index) - 1, frames.shape[1]
    noisy = len(noise_scale) > 0
    state = aligned_rows(4, PITCH, table.dtype)
    residual, count, levels = state[0], state[1], state[2:]
    words = aligned_rows(4, PITCH, np.uint32)
    floats = aligned_rows(3, PITCH, np.float32)
    radius_words, angle_words, normal = words[0], words[1], floats[:2]
    pairs = np.empty((2, (steps + 1) // 2), np.uint32)
    start = folds_of(key, noise.START)
    pixel_radius, pixel_angle = folds_of(key, noise.PIXEL_RADIUS), folds_of(key, noise.PIXEL_ANGLE)
    if noisy:
        pair_radius, pair_angle = folds_of(key, noise.PAIR_RADIUS), folds_of(key, noise.PAIR_ANGLE)
        for pair in range(pairs.shape[1]):
            pairs[0, pair] = word(pair_radius, pair)
            pairs[1, pair] = word(pair_angle, pair)
    saturated, next_hot = 0, 0

    for first in range(0, pixels, PIXELS_A_BLOCK):
        last = min(first + PIXELS_A_BLOCK, pixels)
        hot = next_hot
        while next_hot < len(hot_position) and hot_position[next_hot] < last:
            next_hot += 1
        for i in range(PIXELS_A_BLOCK):
            uniform = np.float32(np.int32(word(start, first + i) >> np.uint32(8))) * _UNIT
            residual[i] = uniform * start_span + start_low
        if is_triangular:
            for i in range(PIXELS_A_BLOCK):
                uniform = np.float32(np.int32(word(start, first + i) >> np.uint32(8))) * _UNIT
                residual[i] = triangular(uniform, threshold_pos, threshold_neg)
        if noisy:
            for i in range(PIXELS_A_BLOCK):
                radius_words[i] = word(pixel_radius, first + i)
                angle_words[i] = word(pixel_angle, first + i)
        now, row = 0, 0
        shown = frames[source_index[0], first:last]
        look_up(table, shown, shown, levels[now])

        for step in range(steps):
            before = now
            if source_index[step + 1] != source_index[step]:
                now = 1 - now
                coming = frames[source_index[min(step + 1 + ROWS_AHEAD, steps)], first:last]
                look_up(table, frames[source_index[step + 1], first:last], coming, levels[now])
            for each in range(hot, next_hot):
                residual[hot_position[each] - first] += hot_drift[each] * hot_scale[step]
            pair, odd = step >> 1, step & 1
            if noisy and not odd:
                two_normals(
                    radius_words, angle_words, pairs[0, pair], pairs[1, pair], words[2], words[3], floats[2], normal
                )
            # Without noise its row is zeros. Adding them changes at most the sign of a zero, which has no effect.
            scale = noise_scale[step] if noisy else tolerance - tolerance
            of_bin = step - row * steps_per_bin
            if of_bin == 0:
                for i in range(PIXELS_A_BLOCK):
                    change = (levels[now, i] - levels[before, i]) + normal[odd, i] * scale
                    count[i], residual[i] = crossed(residual[i] + change, threshold_pos, threshold_neg, tolerance)
            else:
                for i in range(PIXELS_A_BLOCK):
                    change = (levels[now, i] - levels[before, i]) + normal[odd, i] * scale
                    signed, residual[i] = crossed(residual[i] + change, threshold_pos, threshold_neg, tolerance)
                    count[i] += signed
            if of_bin == steps_per_bin - 1:
                saturated += store(count, limit, voxels[row, first:last])
                row += 1
    return saturated
