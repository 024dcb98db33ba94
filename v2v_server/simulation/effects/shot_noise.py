"""Shot noise of R events a second: two Poisson processes, one per polarity, of rate R/2 (1 - 3/4 i(F)).

F is the new frame (v2e). Shot events are added to the step's events, and the pixel restarts from the current
brightness: its residual becomes 0 (v2e).
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_server.simulation import noise
from v2v_server.simulation.effects.state import Clip, compiled, hook
from v2v_server.simulation.intensity import Doubles, exponential
from v2v_server.simulation.pixel import PIXELS_A_BLOCK, folds_of, half_mixed, look_up, word
from v2v_server.simulation.vectors import bits_of_float, use_widest_vectors

FIELD, ROWS = "shot_noise_hz", 0
NOISE, PANEL = True, "still"
PURPOSES = PIXEL_POS, PIXEL_NEG, STEP_POS, STEP_NEG = range(11, 15)
WHITE_SHOT_NOISE = 0.25
"""Shot noise of a white pixel as a share of a black one's (v2e)."""
LARGEST_SHOT_MEAN = 64.0
"""Largest mean number of shot events of one polarity in a step."""
*_, _M2 = noise.MIX_FACTORS


class Tables(NamedTuple):
    """
    Attributes:
        shot: [tables, most, levels] float32 whose bits are uint32: entry k is the chance of more than k events of one
            polarity, in units of 2**-32; no table where there is no shot noise.
        largest: [tables, most] uint32, the largest of all levels.
        table_of_step: [steps] int64, which of the tables holds for the step's duration.
        of_steps: [2, steps] uint32, words of the steps (positive, negative), written at the start of each block.
        drawn: [4, block] uint32: words of the pixels (positive, negative), and of pixels and step.
        first: int64, number of the first step.
    """

    shot: Any
    largest: Any
    table_of_step: Any
    of_steps: Any
    drawn: Any
    first: Any


def prepare(value: float, clip: Clip) -> Tables:
    """Return the tables, see ``effects/__init__.py``."""
    shot = np.empty((0, 0, len(clip.light)), np.uint32)
    if value > 0.0:
        shot = shot_table(shot_means(value, clip.light, clip.durations))
    drawn, of_steps = np.empty((4, PIXELS_A_BLOCK), np.uint32), np.empty((2, len(clip.table_of_step)), np.uint32)
    return Tables(
        shot.view(np.float32), shot.max(axis=2, initial=0), clip.table_of_step, of_steps, drawn, np.int64(clip.first)
    )


def shot_means(shot_noise_hz: float, light: Doubles, durations: Doubles) -> Doubles:
    """Return the mean number of events of one polarity: [durations, levels].

    Raises:
        UsageError: more than LARGEST_SHOT_MEAN.
    """
    means = 0.5 * shot_noise_hz * durations[:, None] * (1.0 - (1.0 - WHITE_SHOT_NOISE) * light)
    if means.max() > LARGEST_SHOT_MEAN:
        raise UsageError(
            f"shot noise of {shot_noise_hz:.6g} events a second makes {means.max():.4g} events of a polarity in a step "
            f"of {durations[-1]:.6g} s; the limit is {LARGEST_SHOT_MEAN:.0f}: lower shot_noise_hz, or use a video with "
            "more frames per second"
        )
    return means


def shot_table(means: Doubles) -> npt.NDArray[np.uint32]:
    """Return the probability of more than k Poisson events in units of 2**-32: [tables, most, levels], for k = 0, 1 ...
    while it is not 0 in those units.
    """
    term = exponential(-means)
    below, layers = term, []
    for k in range(1, 1024):
        chance = np.rint((1.0 - below) * 2.0**32)
        layers.append(np.clip(chance, 0.0, 2.0**32 - 1).astype(np.uint32))
        if not layers[-1].any():
            break
        term = term * means / k
        below = below + term
    return np.ascontiguousarray(np.stack(layers, axis=1))


@hook
def start(tables, own, block, at):
    """Compute the words of the pixels and of the steps."""
    if len(tables.shot) > 0:
        pixel_pos, pixel_neg = folds_of(block.key, PIXEL_POS), folds_of(block.key, PIXEL_NEG)
        step_pos, step_neg = folds_of(block.key, STEP_POS), folds_of(block.key, STEP_NEG)
        for i in range(PIXELS_A_BLOCK):
            tables.drawn[0, i] = word(pixel_pos, at.first + i)
            tables.drawn[1, i] = word(pixel_neg, at.first + i)
        for step in range(tables.of_steps.shape[1]):
            tables.of_steps[0, step] = word(step_pos, np.uint32(tables.first + step))
            tables.of_steps[1, step] = word(step_neg, np.uint32(tables.first + step))


@hook
def after(tables, own, block, at):
    """Add the events, once in a step."""
    if len(tables.shot) > 0 and at.is_last:
        of_step, drawn = tables.table_of_step[at.step], tables.drawn
        _draw(drawn, tables.of_steps[0, at.step], tables.of_steps[1, at.step])
        _fire(
            tables.shot[of_step], tables.largest[of_step], at.shown, drawn, block.floats[3], block.rises,
            block.falls, block.residual,
        )  # fmt: skip


@hook
def _draw(drawn, step_pos, step_neg):
    """Write the ``shot_words`` of a block and one step into the last two rows of ``drawn``."""
    for i in range(PIXELS_A_BLOCK):
        x = half_mixed(np.uint32(drawn[0, i] ^ step_pos))
        y = np.uint32(np.uint32(x ^ (x >> np.uint32(15))) ^ np.uint32(drawn[1, i] ^ step_neg))
        drawn[2, i] = x
        drawn[3, i] = np.uint32(y * _M2)


@compiled
def _fire(chances, largest, shown, drawn, chance, rises, falls, residual):
    """Add shot events to ``rises`` and ``falls`` and clear the residual of the pixels that had any.

    The function is compiled separately: inside the kernel its loops would not become vector instructions.

    Args:
        chances, largest: [most, levels] and [most], one duration's part of the tables.
        shown: [width] uint8 or uint16, the new frame.
        drawn: [4, block] uint32, see ``_draw``.
        chance: [block] float32, working space.
        rises, falls, residual: [block] real, changed.
    """
    use_widest_vectors()  # type: ignore[call-arg]
    none, one = np.float32(0), np.float32(1)
    for k in range(len(chances)):
        look_up(chances[k], shown, shown, chance)
        following = largest[k + 1] if k + 1 < len(chances) else np.uint32(0)
        any_more = False
        for i in range(PIXELS_A_BLOCK):
            bound = np.uint32(np.int32(bits_of_float(chance[i])))
            positive = one if drawn[2, i] < bound else none
            negative = one if drawn[3, i] < bound else none
            any_more |= (drawn[2, i] < following) | (drawn[3, i] < following)
            rises[i] += positive
            falls[i] += negative
            residual[i] *= (one - positive) * (one - negative)
        if not any_more:
            return
