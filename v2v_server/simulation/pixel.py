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

from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic, overload

from v2v_server.simulation import noise

BLOCK_PX = 1024
"""Pixels of a block. Fewer would touch each page of frames and voxels more often, more would not stay in the cache."""

_PITCH = BLOCK_PX + 16  # rows a multiple of 4096 bytes apart would look alike to the processor's store buffer

_GOLDEN = noise.GOLDEN
_S0, _S1, _S2 = noise.SCRAMBLE_FACTORS
_M0, _M1, _M2 = noise.MIX_FACTORS
_L0, _L1, _L2, _L3, _L4, _L5 = noise.LOG_COEFFICIENTS
_A0, _A1, _A2, _A3 = noise.SIN_COEFFICIENTS
_C0, _C1, _C2, _C3 = noise.COS_COEFFICIENTS
_SQRT_HALF_BITS, _MINUS_2_LN_2 = noise.SQRT_HALF_BITS, noise.MINUS_2_LN_2
_PIXEL_RADIUS, _PIXEL_ANGLE = np.uint32(noise.PIXEL_RADIUS), np.uint32(noise.PIXEL_ANGLE)
_PAIR_RADIUS, _PAIR_ANGLE = np.uint32(noise.PAIR_RADIUS), np.uint32(noise.PAIR_ANGLE)
_START = np.uint32(noise.START)
_ONE, _TURN, _UNIT = np.float32(1), np.float32(2.0**-32), np.float32(2.0**-24)
_LOW_31_BITS = np.uint32(0x7FFFFFFF)


@intrinsic
def _float_of_bits(typing_context: Any, bits: Any) -> Any:
    """The float32 whose bit pattern the int32 is."""
    return types.float32(types.int32), lambda context, builder, signature, args: builder.bitcast(
        args[0], ir.FloatType()
    )


@intrinsic
def _bits_of_float(typing_context: Any, value: Any) -> Any:
    """The bit pattern of the float32, as int32."""
    return types.int32(types.float32), lambda context, builder, signature, args: builder.bitcast(
        args[0], ir.IntType(32)
    )


@intrinsic
def _use_widest_vectors(typing_context: Any) -> Any:
    """Lets LLVM use 512-bit vectors in the calling function where the processor has them; ignored elsewhere.

    For some processors LLVM halves them by default, lest a few wide instructions lower the clock of all the others.
    Here the wide ones are the work. llvmlite knows no attributes with a value, hence ``set.add``.
    """

    def generate(context, builder, signature, args):
        set.add(builder.function.attributes, '"prefer-vector-width"="512"')
        return context.get_dummy_value()

    return types.none(), generate


def _log_intensity(table, value):
    """Grey levels go through the table; floating point values are log intensities already."""
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
def _word(key, purpose, counter):
    word = _scramble(np.uint32(np.uint32(counter) + np.uint32(purpose * _GOLDEN)))
    word = _scramble(np.uint32(word + key[0]))
    word = _scramble(np.uint32(word + key[1]))
    word = _scramble(np.uint32(word + key[2]))
    return _scramble(np.uint32(word + key[3]))


@numba.njit(nogil=True, cache=True)
def pixel_words(key, purpose, pixels):
    """``noise.words(key, purpose, arange(pixels))``: [pixels] uint32."""
    words = np.empty(pixels, np.uint32)
    for p in range(pixels):
        words[p] = _word(key, purpose, p)
    return words


@numba.njit(nogil=True, inline="always")
def _two_normals(hashed, radius_word, angle_word, normal, scratch):
    """``noise.mix`` and ``noise.box_muller`` of a block.

    Many short loops: a processor overlaps the rounds of a loop only as far as its window of waiting instructions
    reaches, and a long chain of dependent operations fills that window with a single round.
    """
    for i in range(BLOCK_PX):
        x = np.uint32(hashed[0, i] ^ radius_word)
        x = np.uint32(x ^ (x >> np.uint32(16)))
        x = np.uint32(x * _M0)
        x = np.uint32(x ^ (x >> np.uint32(15)))
        hashed[2, i] = np.uint32(x * _M1)
    for i in range(BLOCK_PX):
        x = hashed[2, i]
        y = np.uint32(np.uint32(x ^ (x >> np.uint32(15))) ^ np.uint32(hashed[1, i] ^ angle_word))
        hashed[2, i] = np.uint32((x & _LOW_31_BITS) | np.uint32(1))
        hashed[3, i] = np.uint32(y * _M2)
    for i in range(BLOCK_PX):
        bits: Any = _bits_of_float(np.float32(np.int32(hashed[2, i])))  # type: ignore[call-arg]
        exponent = np.int32(np.int32(bits - _SQRT_HALF_BITS) >> np.int32(23))
        scratch[0, i] = _float_of_bits(np.int32(bits - np.int32(exponent << np.int32(23)))) - _ONE
        scratch[1, i] = np.float32(np.int32(exponent - np.int32(31))) * _MINUS_2_LN_2
    for i in range(BLOCK_PX):
        fraction = scratch[0, i]
        square = fraction * fraction
        high = (_L2 + _L3 * fraction) + (_L4 + _L5 * fraction) * square
        scratch[1, i] = np.sqrt(scratch[1, i] + fraction * ((_L0 + _L1 * fraction) + high * square))
    for i in range(BLOCK_PX):
        turn = np.float32(np.int32(hashed[3, i])) * _TURN
        square = turn * turn
        fourth = square * square
        normal[0, i] = turn * ((_A0 + _A1 * square) + (_A2 + _A3 * square) * fourth)
        normal[1, i] = (_C0 + _C1 * square) + (_C2 + _C3 * square) * fourth
    for i in range(BLOCK_PX):
        sine, cosine = normal[0, i], normal[1, i]
        twice = sine + sine
        normal[0, i] = scratch[1, i] * (_ONE - twice * sine)
        normal[1, i] = scratch[1, i] * (twice * cosine)


@numba.njit(nogil=True, inline="always")
def _look_up(table, row, levels):
    for i in range(len(row)):
        levels[i] = _log_intensity(table, row[i])


@numba.njit(nogil=True, error_model="numpy")
def _crossed(potential, threshold_pos, threshold_neg, tolerance):
    """Signed events of a potential, and the residual they leave: the rule of ``voxel.py``."""
    rising = potential >= tolerance - tolerance
    threshold = threshold_pos if rising else threshold_neg
    events = np.floor((abs(potential) + tolerance) / threshold)
    signed = events if rising else -events
    return signed, potential - signed * threshold


@numba.njit(nogil=True, inline="always")
def _store(counts, limit, stored):
    saturated = np.int32(0)
    for i in range(len(stored)):
        saturated = np.int32(saturated + np.int32(abs(counts[i]) > limit))
        stored[i] = min(max(counts[i], -limit), limit)
    return saturated


@numba.njit(nogil=True, cache=True, error_model="numpy")
def simulate_pixels(
    frames, table, source_index, key, noise_scale, hot_position, hot_drift, hot_scale,
    threshold_pos, threshold_neg, tolerance, start_low, start_span, steps_per_bin, limit, voxels,
):  # fmt: skip
    """Simulate every pixel of a clip. ``real`` below is float32 or float64, one for all.

    Args:
        frames: [n, pixels] uint8 grey levels, or real log intensities; C-contiguous.
        table: [256] real, log intensity of each grey level.
        source_index: [steps + 1] int64, the row of ``frames`` each position shows; never decreasing.
        key: [4] uint32, the noise key.
        noise_scale: [steps] real, standard deviation of each step's noise; empty for no noise at all.
        hot_position: [count] int64, ascending.
        hot_drift: [count] real, drift per unit of ``hot_scale``.
        hot_scale: [steps] real.
        threshold_pos, threshold_neg, tolerance: real, log units (``voxel.py``).
        start_low, start_span: real, the residual starts uniformly in [low, low + span), log units.
        steps_per_bin: frames_per_bin.
        limit: real, largest count the dtype of ``voxels`` stores.
        voxels: [steps / steps_per_bin, pixels], written.

    Returns:
        number of bins clipped to the limit.
    """
    _use_widest_vectors()  # type: ignore[call-arg]
    steps, pixels = len(source_index) - 1, frames.shape[1]
    noisy = len(noise_scale) > 0
    zero = tolerance - tolerance
    residual, count = np.zeros(BLOCK_PX, table.dtype), np.zeros(BLOCK_PX, table.dtype)
    levels = np.zeros((2, _PITCH), table.dtype)
    hashed = np.zeros((4, _PITCH), np.uint32)
    scratch = np.zeros((2, _PITCH), np.float32)
    normal = np.zeros((2, _PITCH), np.float32)
    pairs = np.empty((2, (steps + 1) // 2), np.uint32)
    if noisy:
        for pair in range(pairs.shape[1]):
            pairs[0, pair] = _word(key, _PAIR_RADIUS, pair)
            pairs[1, pair] = _word(key, _PAIR_ANGLE, pair)
    saturated, next_hot = 0, 0

    for first in range(0, pixels, BLOCK_PX):
        width = min(BLOCK_PX, pixels - first)
        hot = next_hot
        while next_hot < len(hot_position) and hot_position[next_hot] < first + width:
            next_hot += 1
        for i in range(BLOCK_PX):
            uniform = np.float32(np.int32(_word(key, _START, first + i) >> np.uint32(8))) * _UNIT
            residual[i] = uniform * start_span + start_low
        if noisy:
            for i in range(BLOCK_PX):
                hashed[0, i] = _word(key, _PIXEL_RADIUS, first + i)
                hashed[1, i] = _word(key, _PIXEL_ANGLE, first + i)
        now = 0
        _look_up(table, frames[source_index[0], first : first + width], levels[now])

        row, due = 0, steps_per_bin
        for step in range(steps):
            before = now
            if source_index[step + 1] != source_index[step]:
                now = 1 - now
                _look_up(table, frames[source_index[step + 1], first : first + width], levels[now])
            for each in range(hot, next_hot):
                residual[hot_position[each] - first] += hot_drift[each] * hot_scale[step]
            if noisy:
                pair, odd = step >> 1, step & 1
                if not odd:
                    _two_normals(hashed, pairs[0, pair], pairs[1, pair], normal, scratch)
                scale = noise_scale[step]
                for i in range(BLOCK_PX):
                    change = (levels[now, i] - levels[before, i]) + normal[odd, i] * scale
                    signed, residual[i] = _crossed(residual[i] + change, threshold_pos, threshold_neg, tolerance)
                    count[i] += signed
            else:
                for i in range(BLOCK_PX):
                    change = levels[now, i] - levels[before, i]
                    signed, residual[i] = _crossed(residual[i] + change, threshold_pos, threshold_neg, tolerance)
                    count[i] += signed
            due -= 1
            if due == 0:
                saturated += _store(count, limit, voxels[row, first : first + width])
                for i in range(BLOCK_PX):
                    count[i] = zero
                row, due = row + 1, steps_per_bin
    return saturated
