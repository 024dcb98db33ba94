"""The pixel kernel with effects: that of ``pixel.py`` and, one by one, what ``effects.py`` adds to it.

A kernel of its own, so that a camera without effects runs the code it always ran. Loops, order of operations and
promises are those of ``pixel.py``, whose inner functions it calls.
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

import numba
import numpy as np

from v2v_server.simulation import noise
from v2v_server.simulation.pixel import BLOCK_PX, _crossed, _folds, _look_up, _store, _two_normals, _word
from v2v_server.simulation.vectors import aligned_rows, bits_of_float, use_widest_vectors

_PITCH = BLOCK_PX + 16  # see pixel.py
_ROWS_AHEAD = 3
_M0, _M1, _M2 = noise.MIX_FACTORS
_PIXEL_RADIUS, _PIXEL_ANGLE = np.uint32(noise.PIXEL_RADIUS), np.uint32(noise.PIXEL_ANGLE)
_PAIR_RADIUS, _PAIR_ANGLE = np.uint32(noise.PAIR_RADIUS), np.uint32(noise.PAIR_ANGLE)
_START = np.uint32(noise.START)
_MISMATCH_RADIUS, _MISMATCH_ANGLE = np.uint32(noise.MISMATCH_RADIUS), np.uint32(noise.MISMATCH_ANGLE)
_SHOT_PIXEL_POS, _SHOT_PIXEL_NEG = np.uint32(noise.SHOT_PIXEL_POS), np.uint32(noise.SHOT_PIXEL_NEG)
_SHOT_STEP_POS, _SHOT_STEP_NEG = np.uint32(noise.SHOT_STEP_POS), np.uint32(noise.SHOT_STEP_NEG)
_ONE, _UNIT = np.float32(1), np.float32(2.0**-24)


@numba.njit(nogil=True, error_model="numpy")
def _crossed_with_refractory(residual, blind, change, seconds, refractory, threshold_pos, threshold_neg, tolerance):
    """Signed events, residual and blind seconds after a step whose change is linear in time.

    In log units, a period between events is the threshold plus what the change would have done while blind.
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


@numba.njit(nogil=True, inline="always")
def _shot_words(pixel_pos, pixel_neg, step_pos, step_neg, drawn):
    """``noise.shot_words`` of a block and one step, into ``drawn`` [2, block]."""
    for i in range(BLOCK_PX):
        x = np.uint32(pixel_pos[i] ^ step_pos)
        x = np.uint32(x ^ (x >> np.uint32(16)))
        x = np.uint32(x * _M0)
        x = np.uint32(x ^ (x >> np.uint32(15)))
        x = np.uint32(x * _M1)
        y = np.uint32(np.uint32(x ^ (x >> np.uint32(15))) ^ np.uint32(pixel_neg[i] ^ step_neg))
        drawn[0, i] = x
        drawn[1, i] = np.uint32(y * _M2)


@numba.njit(nogil=True)
def _shot_events(chances, largest, shown, drawn, chance, signed, residual):
    """Adds shot events to ``signed`` and clears the residual of the pixels that had any.

    A function that is compiled by itself: as a part of the kernel its loops would not become vector instructions.

    Args:
        chances, largest: [most, 256] and [most], one duration's part of ``effects.Prepared.shot`` and ``shot_largest``.
        shown: [width] uint8, the new frame.
        drawn: [2, block] uint32, see ``_shot_words``.
        chance: [block] float32, working space.
        signed, residual: [block] real, changed.
    """
    use_widest_vectors()  # type: ignore[call-arg]
    none, one = np.float32(0), np.float32(1)
    for k in range(len(chances)):
        _look_up(chances[k], shown, shown, chance)
        following = largest[k + 1] if k + 1 < len(chances) else np.uint32(0)
        any_more = False
        for i in range(BLOCK_PX):
            bound = np.uint32(np.int32(bits_of_float(chance[i])))
            positive = one if drawn[0, i] < bound else none
            negative = one if drawn[1, i] < bound else none
            any_more |= (drawn[0, i] < following) | (drawn[1, i] < following)
            signed[i] += positive - negative
            residual[i] *= (one - positive) * (one - negative)
        if not any_more:
            return


@numba.njit(nogil=True, cache=True, error_model="numpy")
def simulate_pixels_with_effects(
    frames, table, source_index, key, noise_scale, hot_position, hot_drift, hot_scale,
    threshold_pos, threshold_neg, tolerance, drawn_start, start_residual, steps_per_bin, limit, voxels,
    mismatch_sigma, smallest_share, low_pass, shot, shot_largest, table_of_step, leak, seconds, refractory,
    dead_position,
):  # fmt: skip
    """Simulate every pixel of a clip, effects included.

    Args:
        frames: [n, pixels] uint8 grey levels, C-contiguous.
        table .. tolerance, steps_per_bin, limit, voxels: as in ``pixel.simulate_pixels``.
        drawn_start: True starts every residual uniformly between its own thresholds, False at ``start_residual``, real.
        mismatch_sigma .. dead_position: the fields of ``effects.Prepared``.

    Returns:
        number of bins clipped to the limit.
    """
    use_widest_vectors()  # type: ignore[call-arg]
    steps, pixels = len(source_index) - 1, frames.shape[1]
    noisy, filtered, shots, leaks = len(noise_scale) > 0, len(low_pass) > 0, len(shot) > 0, len(leak) > 0
    zero = tolerance - tolerance
    has_refractory = refractory > zero
    state = aligned_rows(12, _PITCH, table.dtype)
    residual, count, change, seen, slow, fast, blind, signed = (
        state[0], state[1], state[2], state[3], state[4], state[5], state[6], state[7],
    )  # fmt: skip
    positive, negative, levels = state[8], state[9], state[10:]
    words = aligned_rows(8, _PITCH, np.uint32)
    floats = aligned_rows(4, _PITCH, np.float32)
    radius_words, angle_words, shot_pos, shot_neg, drawn = words[0], words[1], words[4], words[5], words[6:]
    normal, chance = floats[:2], floats[3]
    start_folds = _folds(key, _START)
    pixel_radius, pixel_angle = _folds(key, _PIXEL_RADIUS), _folds(key, _PIXEL_ANGLE)
    pair_radius, pair_angle = _folds(key, _PAIR_RADIUS), _folds(key, _PAIR_ANGLE)
    mismatch_radius, mismatch_angle = _folds(key, _MISMATCH_RADIUS), _folds(key, _MISMATCH_ANGLE)
    pixel_pos, pixel_neg = _folds(key, _SHOT_PIXEL_POS), _folds(key, _SHOT_PIXEL_NEG)
    step_pos, step_neg = _folds(key, _SHOT_STEP_POS), _folds(key, _SHOT_STEP_NEG)
    saturated, next_hot, next_dead = 0, 0, 0

    for first in range(0, pixels, BLOCK_PX):
        last = min(first + BLOCK_PX, pixels)
        hot, dead = next_hot, next_dead
        while next_hot < len(hot_position) and hot_position[next_hot] < last:
            next_hot += 1
        while next_dead < len(dead_position) and dead_position[next_dead] < last:
            next_dead += 1
        for i in range(BLOCK_PX):
            positive[i], negative[i], blind[i] = threshold_pos, threshold_neg, zero
        if mismatch_sigma > zero:
            for i in range(BLOCK_PX):
                radius_words[i] = _word(mismatch_radius, first + i)
                angle_words[i] = _word(mismatch_angle, first + i)
            _two_normals(radius_words, angle_words, np.uint32(0), np.uint32(0), words[2], words[3], floats[2], normal)
            for i in range(BLOCK_PX):
                positive[i] *= max(_ONE + normal[0, i] * mismatch_sigma, smallest_share)
                negative[i] *= max(_ONE + normal[1, i] * mismatch_sigma, smallest_share)
        for i in range(BLOCK_PX):
            uniform = np.float32(np.int32(_word(start_folds, first + i) >> np.uint32(8))) * _UNIT
            residual[i] = uniform * (positive[i] + negative[i]) - negative[i] if drawn_start else start_residual
        if noisy:
            for i in range(BLOCK_PX):
                radius_words[i] = _word(pixel_radius, first + i)
                angle_words[i] = _word(pixel_angle, first + i)
        if shots:
            for i in range(BLOCK_PX):
                shot_pos[i] = _word(pixel_pos, first + i)
                shot_neg[i] = _word(pixel_neg, first + i)
        now, row = 0, 0
        shown = frames[source_index[0], first:last]
        _look_up(table, shown, shown, levels[now])
        for i in range(BLOCK_PX):
            seen[i] = levels[now, i]

        for step in range(steps):
            before, moved = now, source_index[step + 1] != source_index[step]
            shown = frames[source_index[step + 1], first:last]
            if moved:
                now = 1 - now
                coming = frames[source_index[min(step + 1 + _ROWS_AHEAD, steps)], first:last]
                _look_up(table, shown, coming, levels[now])
            of_step = table_of_step[step]
            if filtered:
                if moved or step == 0 or of_step != table_of_step[step - 1]:
                    _look_up(low_pass[of_step, 0], shown, shown, slow)
                    _look_up(low_pass[of_step, 1], shown, shown, fast)
                for i in range(BLOCK_PX):
                    old, new = levels[before, i], levels[now, i]
                    change[i] = slow[i] * (old - seen[i]) + fast[i] * (new - old)
                    seen[i] += change[i]
            else:
                for i in range(BLOCK_PX):
                    change[i] = levels[now, i] - levels[before, i]
            if noisy:
                pair, odd = step >> 1, step & 1
                if not odd:
                    of_pair = _word(pair_radius, pair), _word(pair_angle, pair)
                    _two_normals(
                        radius_words, angle_words, of_pair[0], of_pair[1], words[2], words[3], floats[2], normal
                    )
                scale = noise_scale[step]
                for i in range(BLOCK_PX):
                    change[i] += normal[odd, i] * scale
            if leaks:
                leaked = leak[step]
                for i in range(BLOCK_PX):
                    change[i] += positive[i] * leaked
            for each in range(hot, next_hot):
                change[hot_position[each] - first] += hot_drift[each] * hot_scale[step]
            if has_refractory:
                duration = seconds[step]
                for i in range(BLOCK_PX):
                    signed[i], residual[i], blind[i] = _crossed_with_refractory(
                        residual[i], blind[i], change[i], duration, refractory, positive[i], negative[i], tolerance
                    )
            else:
                for i in range(BLOCK_PX):
                    signed[i], residual[i] = _crossed(residual[i] + change[i], positive[i], negative[i], tolerance)
            if shots:
                _shot_words(shot_pos, shot_neg, _word(step_pos, step), _word(step_neg, step), drawn)
                _shot_events(shot[of_step], shot_largest[of_step], shown, drawn, chance, signed, residual)
            of_bin = step - row * steps_per_bin
            if of_bin == 0:
                for i in range(BLOCK_PX):
                    count[i] = signed[i]
            else:
                for i in range(BLOCK_PX):
                    count[i] += signed[i]
            if of_bin == steps_per_bin - 1:
                for each in range(dead, next_dead):
                    count[dead_position[each] - first] = zero
                saturated += _store(count, limit, voxels[row, first:last])
                row += 1
    return saturated
