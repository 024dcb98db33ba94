"""The pixel kernel with effects: ``pixel.py`` with the additions of each effect.

It is a separate kernel, so that a camera without effects runs the simpler code. Loops, order of operations and promises
are those of ``pixel.py``, whose inner functions it calls. The effects' functions are compiled into it: an effect that
is off costs one comparison per block and step.
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from typing import Any

import numba
import numpy as np

from v2v_server.simulation import noise
from v2v_server.simulation.effects import EFFECTS
from v2v_server.simulation.effects.state import At, Block, compiled, hook
from v2v_server.simulation.pixel import (
    BLOCK_PX,
    PITCH,
    ROWS_AHEAD,
    crossed,
    folds_of,
    look_up,
    store,
    two_normals,
    word,
)
from v2v_server.simulation.vectors import aligned_rows, use_widest_vectors

_PIXEL_RADIUS, _PIXEL_ANGLE = np.uint32(noise.PIXEL_RADIUS), np.uint32(noise.PIXEL_ANGLE)
_PAIR_RADIUS, _PAIR_ANGLE = np.uint32(noise.PAIR_RADIUS), np.uint32(noise.PAIR_ANGLE)
_START = np.uint32(noise.START)
_UNIT = np.float32(2.0**-24)


def _linked(name: str, link: Any) -> Any:
    """Build one compiled function of (tables, rows, block, at) from the hooks of all effects that have it, in their
    order.
    """

    @hook
    def chain(tables, rows, block, at):
        return False

    for number in reversed(range(len(EFFECTS))):
        if hasattr(EFFECTS[number], name):
            first = sum(effect.ROWS for effect in EFFECTS[:number])
            chain = link(number, first, first + EFFECTS[number].ROWS, getattr(EFFECTS[number], name), chain)
    return chain


def _each(number: int, first: int, last: int, function: Any, rest: Any) -> Any:
    @hook
    def chain(tables, rows, block, at):
        function(tables[number], rows[first:last], block, at)
        return rest(tables, rows, block, at)

    return chain


def _until_true(number: int, first: int, last: int, function: Any, rest: Any) -> Any:
    @hook
    def chain(tables, rows, block, at):
        return function(tables[number], rows[first:last], block, at) or rest(tables, rows, block, at)

    return chain


_start, _see, _change, _after, _close = (_linked(name, _each) for name in ("start", "see", "change", "after", "close"))
_cross = _linked("cross", _until_true)
_OWN_ROWS = sum(effect.ROWS for effect in EFFECTS)


@compiled
def _simulate(
    frames, table, source_index, key, noise_scale, hot_position, hot_drift, hot_scale, threshold_pos, threshold_neg,
    tolerance, drawn_start, start_residual, steps_per_bin, limit, voxels, tables, state, words, floats,
):  # fmt: skip
    """Run the kernel without reference counting, which every view of an array would cost; the caller provides all
    memory.
    """
    use_widest_vectors()  # type: ignore[call-arg]
    steps, pixels = len(source_index) - 1, frames.shape[1]
    noisy = len(noise_scale) > 0
    residual, count, change, signed, positive, negative = state[0], state[1], state[2], state[3], state[4], state[5]
    levels, own = state[6:8], state[8:]
    radius_words, angle_words, normal = words[4], words[5], floats[4:]
    block = Block(residual, count, change, signed, positive, negative, levels, words[:4], floats[:4], tolerance, key)
    start_folds = folds_of(key, _START)
    pixel_radius, pixel_angle = folds_of(key, _PIXEL_RADIUS), folds_of(key, _PIXEL_ANGLE)
    pair_radius, pair_angle = folds_of(key, _PAIR_RADIUS), folds_of(key, _PAIR_ANGLE)
    saturated, next_hot = 0, 0

    for first in range(0, pixels, BLOCK_PX):
        last = min(first + BLOCK_PX, pixels)
        hot = next_hot
        while next_hot < len(hot_position) and hot_position[next_hot] < last:
            next_hot += 1
        now, row = 0, 0
        shown = frames[source_index[0], first:last]
        look_up(table, shown, shown, levels[now])
        for i in range(BLOCK_PX):
            positive[i], negative[i] = threshold_pos, threshold_neg
        _start(tables, own, block, At(first, 0, False, now, now, shown))
        for i in range(BLOCK_PX):
            uniform = np.float32(np.int32(word(start_folds, first + i) >> np.uint32(8))) * _UNIT
            residual[i] = uniform * (positive[i] + negative[i]) - negative[i] if drawn_start else start_residual
        if noisy:
            for i in range(BLOCK_PX):
                radius_words[i] = word(pixel_radius, first + i)
                angle_words[i] = word(pixel_angle, first + i)

        for step in range(steps):
            before, moved = now, source_index[step + 1] != source_index[step]
            shown = frames[source_index[step + 1], first:last]
            if moved:
                now = 1 - now
                coming = frames[source_index[min(step + 1 + ROWS_AHEAD, steps)], first:last]
                look_up(table, shown, coming, levels[now])
            at = At(first, step, moved, before, now, shown)
            for i in range(BLOCK_PX):
                change[i] = levels[now, i] - levels[before, i]
            _see(tables, own, block, at)
            if noisy:
                pair, odd = step >> 1, step & 1
                if not odd:
                    of_pair = word(pair_radius, pair), word(pair_angle, pair)
                    two_normals(
                        radius_words, angle_words, of_pair[0], of_pair[1], words[2], words[3], floats[2], normal
                    )
                scale = noise_scale[step]
                for i in range(BLOCK_PX):
                    change[i] += normal[odd, i] * scale
            _change(tables, own, block, at)
            for each in range(hot, next_hot):
                change[hot_position[each] - first] += hot_drift[each] * hot_scale[step]
            if not _cross(tables, own, block, at):
                for i in range(BLOCK_PX):
                    signed[i], residual[i] = crossed(residual[i] + change[i], positive[i], negative[i], tolerance)
            _after(tables, own, block, at)
            of_bin = step - row * steps_per_bin
            if of_bin == 0:
                for i in range(BLOCK_PX):
                    count[i] = signed[i]
            else:
                for i in range(BLOCK_PX):
                    count[i] += signed[i]
            if of_bin == steps_per_bin - 1:
                _close(tables, own, block, at)
                saturated += store(count, limit, voxels[row, first:last])
                row += 1
    return saturated


@numba.njit(nogil=True, cache=True, error_model="numpy")
def simulate_pixels_with_effects(
    frames, table, source_index, key, noise_scale, hot_position, hot_drift, hot_scale,
    threshold_pos, threshold_neg, tolerance, drawn_start, start_residual, steps_per_bin, limit, voxels, tables,
):  # fmt: skip
    """Simulate every pixel of a clip, effects included.

    Args:
        frames: [n, pixels] uint8 grey levels, C-contiguous.
        table .. tolerance, steps_per_bin, limit, voxels: as in ``pixel.simulate_pixels``.
        drawn_start: True starts every residual uniformly between its own thresholds, False at ``start_residual``, real.
        tables: of all effects, ``effects.prepare``.

    Returns:
        number of bins clipped to the limit.
    """
    state = aligned_rows(8 + _OWN_ROWS, PITCH, table.dtype)
    words = aligned_rows(6, PITCH, np.uint32)
    floats = aligned_rows(6, PITCH, np.float32)
    return _simulate(
        frames, table, source_index, key, noise_scale, hot_position, hot_drift, hot_scale, threshold_pos, threshold_neg,
        tolerance, drawn_start, start_residual, steps_per_bin, limit, voxels, tables, state, words, floats,
    )  # fmt: skip
