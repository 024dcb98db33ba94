"""The general kernel: ``pixel.py`` with effects, segments of a step, both polarities and the times of events.

It is a separate kernel, so that a clip without these runs the simpler code. Loops, order of operations and promises
are those of ``pixel.py``, whose inner functions it calls: where both can simulate a clip, they count the same events.
The functions of effects and representations are compiled into it: one that is off costs one comparison per block and
segment.
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from typing import Any, NamedTuple

import numba
import numpy as np

from v2v_server.simulation import noise
from v2v_server.simulation.effects import EFFECTS
from v2v_server.simulation.effects.state import LEGS, At, Block, compiled, hook
from v2v_server.simulation.pixel import (
    PITCH,
    PIXELS_A_BLOCK,
    ROWS_AHEAD,
    crossed,
    folds_of,
    look_up,
    triangular,
    two_normals,
    word,
)
from v2v_server.simulation.representations import REPRESENTATIONS, Counts, Train
from v2v_server.simulation.vectors import aligned_rows, use_widest_vectors

_UNIT, _WHOLE = np.float32(2.0**-24), np.float32(1)
_FIRST_ROW = (0, *accumulate(effect.ROWS for effect in EFFECTS))
ROWS = _FIRST_ROW[-1]
"""Rows of a block's state that the effects need."""
_OWN = 17 + LEGS
_CARRIED = (0, *range(_OWN, _OWN + ROWS))
"""Rows of a block's state that outlive a clip: the residual, and those of the effects."""
FIXED, UNIFORM, TRIANGULAR = range(3)
"""How residuals start."""


class Segments(NamedTuple):
    """The clip's segments (``voxel.Timeline``) and what each adds; all [G].

    Attributes:
        step: int64, the step that holds it.
        level: int64, row of the frames that the known level at or after its end comes from, or -1 - k for row k of the
            intermediate levels.
        shown: int64, row of the frame at the end of its step.
        reached: real, its end between the known levels; 1 is the later one.
        bin: int64.
        noise_scale: real, standard deviation of the noise; empty for no noise at all.
        hot_scale: real, its part of a hot pixel's drift.
        first: number of the first segment; above 0 for a clip that continues another one.
        resumed: whether it starts from the state at the end of that one.
    """

    step: Any
    level: Any
    shown: Any
    reached: Any
    bin: Any
    noise_scale: Any
    hot_scale: Any
    first: Any
    resumed: Any


def _linked(entries: Sequence[Any], name: str, link: Any) -> Any:
    """Build one compiled function from the functions of all entries that have it, in their order."""

    @hook
    def chain(*_):
        return False

    for number in reversed(range(len(entries))):
        if hasattr(entries[number], name):
            chain = link(number, getattr(entries[number], name), chain)
    return chain


def _each(number: int, function: Any, rest: Any) -> Any:
    first, last = _FIRST_ROW[number : number + 2]

    @hook
    def chain(tables, rows, block, at):
        function(tables[number], rows[first:last], block, at)
        return rest(tables, rows, block, at)

    return chain


def _until_true(number: int, function: Any, rest: Any) -> Any:
    first, last = _FIRST_ROW[number : number + 2]

    @hook
    def chain(tables, rows, block, at):
        return function(tables[number], rows[first:last], block, at) or rest(tables, rows, block, at)

    return chain


def _counted(number: int, function: Any, rest: Any) -> Any:
    @hook
    def chain(made, clipped, argument):
        clipped[number] += function(made[number], argument)
        return rest(made, clipped, argument)

    return chain


_start, _see, _change, _after = (_linked(EFFECTS, name, _each) for name in ("start", "see", "change", "after"))
_divide, _cross = (_linked(EFFECTS, name, _until_true) for name in ("divide", "cross"))
_begin, _events, _end = (
    _linked(tuple(REPRESENTATIONS.values()), name, _counted) for name in ("begin", "events", "end")
)


@compiled
def _simulate(
    frames, between_frames, table, fine, key, segments, hot_position, hot_drift, threshold_pos, threshold_neg,
    tolerance, start, start_residual, drifts_first, timed, is_plain, bins, limit, made, clipped, tables, carried, kept,
    state, words, floats,
):  # fmt: skip
    """Run the kernel in memory of the caller, so that views of arrays need no reference counting."""
    use_widest_vectors()  # type: ignore[call-arg]
    count, pixels = len(segments.step), frames.shape[1]
    noisy = len(segments.noise_scale) > 0
    # One by one: rows that are unpacked from an array have unknown strides, and their loops are not vectorised.
    residual, change, signed, positive, negative, rises = state[0], state[1], state[2], state[3], state[4], state[5]
    falls, waited, blind, on, off, old = state[6], state[7], state[8], state[9], state[10], state[11]
    shares, legs = state[16], state[17:_OWN]
    levels, own = state[12:16], state[_OWN:]
    radius_words, angle_words, normal = words[4], words[5], floats[4:]
    block = Block(
        residual, change, signed, rises, falls, waited, blind, timed, positive, negative, levels, words[:4],
        floats[:4], tolerance, key, legs, shares,
    )  # fmt: skip
    zero = tolerance - tolerance
    start_folds, time_folds = folds_of(key, noise.START), folds_of(key, noise.TIME)
    pixel_radius, pixel_angle = folds_of(key, noise.PIXEL_RADIUS), folds_of(key, noise.PIXEL_ANGLE)
    pair_radius, pair_angle = folds_of(key, noise.PAIR_RADIUS), folds_of(key, noise.PAIR_ANGLE)
    next_hot = 0

    for first in range(0, pixels, PIXELS_A_BLOCK):
        last = min(first + PIXELS_A_BLOCK, pixels)
        hot = next_hot
        while next_hot < len(hot_position) and hot_position[next_hot] < last:
            next_hot += 1
        # Rows of ``levels``: 0 and 1 are known levels, the later one being ``known``; 2 and 3 lie between them.
        now, known, known_before, row, pair_done = 0, 0, 0, 0, -1
        shown = frames[0, first:last]
        look_up(table, shown, shown, levels[now])
        _begin(made, clipped, first)
        for i in range(PIXELS_A_BLOCK):
            positive[i], negative[i] = threshold_pos, threshold_neg
        _start(tables, own, block, At(first, 0, False, now, now, shown))
        for i in range(PIXELS_A_BLOCK):
            uniform = np.float32(np.int32(word(start_folds, first + i) >> np.uint32(8))) * _UNIT
            residual[i] = uniform * (positive[i] + negative[i]) - negative[i] if start == UNIFORM else start_residual
            if start == TRIANGULAR:
                residual[i] = triangular(uniform, positive[i], negative[i])
        if segments.resumed:
            for row in range(len(carried)):
                for i in range(last - first):
                    state[_CARRIED[row], i] = carried[row, first + i]
        if timed:
            for i in range(PIXELS_A_BLOCK):
                old[i], waited[i], blind[i] = residual[i], zero, zero
        if noisy:
            for i in range(PIXELS_A_BLOCK):
                radius_words[i] = word(pixel_radius, first + i)
                angle_words[i] = word(pixel_angle, first + i)

        for each in range(count):
            before, step, level = now, segments.step[each], segments.level[each]
            if each == 0 or segments.reached[each - 1] >= 1:
                moved, known_before = level != row, known
            else:
                moved = False
            if moved:
                known, row = 1 - known, level
                if level >= 0:
                    coming = frames[segments.shown[min(each + ROWS_AHEAD, count - 1)], first:last]
                    look_up(table, frames[level, first:last], coming, levels[known])
                else:
                    for i in range(last - first):
                        levels[known, i] = fine[between_frames[-1 - level, first + i]]
            if segments.reached[each] >= 1:
                now = known
            elif known_before != known:
                now, reached = 2 + (each & 1), segments.reached[each]
                for i in range(PIXELS_A_BLOCK):
                    levels[now, i] = levels[known_before, i] + (levels[known, i] - levels[known_before, i]) * reached
            if noisy and step >> 1 != pair_done:
                pair_done = step >> 1
                two_normals(
                    radius_words, angle_words, word(pair_radius, pair_done), word(pair_angle, pair_done), words[2],
                    words[3], floats[2], normal,
                )  # fmt: skip
            scale, odd = segments.noise_scale[each] if noisy else zero, step & 1
            of_bin = segments.bin[each]
            is_first = each == 0 or segments.bin[each - 1] != of_bin
            if is_plain:
                for spot in range(hot, next_hot):
                    residual[hot_position[spot] - first] += hot_drift[spot] * segments.hot_scale[each]
                # The loops of ``simulate_pixels``, written out: a function for both makes numba count references,
                # and the paper's kernel 4 % slower.
                if is_first:
                    for i in range(PIXELS_A_BLOCK):
                        more = (levels[now, i] - levels[before, i]) + normal[odd, i] * scale
                        on[i], residual[i] = crossed(residual[i] + more, threshold_pos, threshold_neg, tolerance)
                else:
                    for i in range(PIXELS_A_BLOCK):
                        more = (levels[now, i] - levels[before, i]) + normal[odd, i] * scale
                        events, residual[i] = crossed(residual[i] + more, threshold_pos, threshold_neg, tolerance)
                        on[i] += events
            else:
                shown = frames[segments.shown[each], first:last]
                at = At(first, each, moved, before, now, shown)
                for i in range(PIXELS_A_BLOCK):
                    change[i] = levels[now, i] - levels[before, i]
                _see(tables, own, block, at)
                if noisy:
                    for i in range(PIXELS_A_BLOCK):
                        change[i] += normal[odd, i] * scale
                _change(tables, own, block, at)
                drifting = residual if drifts_first else change
                for spot in range(hot, next_hot):
                    drifting[hot_position[spot] - first] += hot_drift[spot] * segments.hot_scale[each]
                is_divided, begun = _divide(tables, own, block, at), zero
                if not is_divided:
                    shares[0] = _WHOLE
                parts = LEGS if is_divided else 1
                for leg in range(parts):
                    at = At(first, each, moved, before, now, shown, shares[leg], begun, leg == parts - 1)
                    if is_divided:
                        for i in range(PIXELS_A_BLOCK):
                            change[i] = legs[leg, i]
                    if not _cross(tables, own, block, at):
                        for i in range(PIXELS_A_BLOCK):
                            events, residual[i] = crossed(residual[i] + change[i], positive[i], negative[i], tolerance)
                            signed[i], rises[i], falls[i] = events, max(events, zero), max(zero - events, zero)
                    _after(tables, own, block, at)
                    if is_first and leg == 0:
                        for i in range(PIXELS_A_BLOCK):
                            on[i], off[i] = rises[i], falls[i]
                    else:
                        for i in range(PIXELS_A_BLOCK):
                            on[i] += rises[i]
                            off[i] += falls[i]
                    if timed:
                        if drifts_first:
                            for spot in range(hot, next_hot):
                                change[hot_position[spot] - first] += hot_drift[spot] * segments.hot_scale[each]
                        _time(segments.first + each, block, at, old, last, time_folds, made, clipped)
                        for i in range(PIXELS_A_BLOCK):
                            old[i] = residual[i]
                    begun += shares[leg]
            if each == count - 1 or segments.bin[each + 1] != of_bin:
                net = on if is_plain else signed
                if not is_plain:
                    for i in range(PIXELS_A_BLOCK):
                        net[i] = on[i] - off[i]
                _end(made, clipped, Counts(first, last, of_bin // bins, of_bin % bins, limit, net, on, off))
        for row in range(len(kept)):
            for i in range(last - first):
                kept[row, first + i] = state[_CARRIED[row], i]


@compiled
def _time(number, block, at, old, last, folds, made, clipped):
    """Give every event of a segment, or of a leg of it, its time, and pass it to the representations.

    Crossings of one pixel come at equal distances. Events that no change of intensity caused (shot noise) come at
    random times of the segment.

    Args:
        number: of the segment, for the noise.
        old: [block] real, the residual at its start.
        folds: of the noise's words for these times.
    """
    found, count, first = block.words[0], 0, at.first
    for pixel in range(last - first):  # without a branch: most pixels have no events
        found[count] = pixel
        count += block.rises[pixel] + block.falls[pixel] > 0
    for place in range(count):
        i = np.int64(found[place])
        for is_rising in range(2):
            events = int(block.rises[i] if is_rising else block.falls[i])
            if events == 0:
                continue
            sign = 2 * is_rising - 1
            crossings = min(events, max(sign * int(block.signed[i]), 0))
            threshold = np.float64(block.positive[i] if is_rising else block.negative[i])
            speed = abs(np.float64(block.change[i]))
            passed, apart = 0.0, 0.0
            if speed > 0.0:
                apart = block.blind[i] + threshold / speed
                # An event may be due a rounding before or after the segment.
                passed = min(max(block.waited[i] + (threshold - sign * np.float64(old[i])) / speed, 0.0), 1.0)
                apart = min(apart, (1.0 - passed) / max(crossings - 1, 1))
            if crossings > 0:
                passed, apart = at.begun + at.share * passed, at.share * apart
                _events(made, clipped, Train(first + i, i, at.step, is_rising, passed, apart, crossings))
            for k in range(crossings, events):
                drawn = word((word(folds, first + i), np.uint32(number)), np.uint32(2 * k + is_rising))
                passed = np.float64(np.int64(drawn)) * 2.0**-32
                _events(made, clipped, Train(first + i, i, at.step, is_rising, passed, 0.0, 1))


@numba.njit(nogil=True, cache=True, error_model="numpy")
def simulate_general(
    frames, between_frames, table, fine, key, segments, hot_position, hot_drift, threshold_pos, threshold_neg,
    tolerance, start, start_residual, drifts_first, timed, is_plain, bins, limit, made, clipped, tables, carried,
    kept,
):  # fmt: skip
    """Simulate every pixel of a clip.

    Args:
        frames: [n, pixels] uint8 or uint16 grey levels, or real log intensities; C-contiguous. Row 0 is the clip's
            first frame.
        between_frames: [K, pixels] uint16, intermediate levels (``voxel.Levels``).
        fine: their log intensity, real (``intensity.fine_table``).
        table, key, hot_position, hot_drift: as in ``pixel.simulate_pixels``.
        segments: what is simulated, and when.
        threshold_pos, threshold_neg, tolerance: real, log units (``voxel.py``).
        start: FIXED starts every residual at ``start_residual``, real; UNIFORM and TRIANGULAR draw it between the
            pixel's own thresholds.
        drifts_first: True adds a hot pixel's drift in the order of ``pixel.simulate_pixels``, for the same roundings.
        timed: whether events need times: a representation has ``events``.
        is_plain: whether there are no effects, and nothing but voxels is made.
        bins: of a voxel grid.
        limit: real, largest count that the dtype of the voxels stores.
        made: tables of all representations; written.
        clipped: [representations] int64, to which the number of values that did not fit is added.
        tables: of all effects, ``effects.prepare``.
        carried: [1 + ROWS, pixels] real, residuals and the effects' rows at the start, if ``segments.resumed``; without
            effects, [1, pixels].
        kept: the same at the end, written; of no rows if it is not wanted.
    """
    state = aligned_rows(_OWN + ROWS, PITCH, table.dtype)
    words = aligned_rows(6, PITCH, np.uint32)
    floats = aligned_rows(6, PITCH, np.float32)
    _simulate(
        frames, between_frames, table, fine, key, segments, hot_position, hot_drift, threshold_pos, threshold_neg,
        tolerance, start, start_residual, drifts_first, timed, is_plain, bins, limit, made, clipped, tables,
        carried, kept, state, words, floats,
    )  # fmt: skip
