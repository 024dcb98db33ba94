"""Effects beyond the paper's pixel model: one file per effect, off at zero.

    mismatch.py       every pixel has its own thresholds
    photoreceptor.py  a low-pass filter, slower in the dark
    leak.py           positive events without a change of brightness
    noise_band.py     band-limited noise of the log intensity
    refractory.py     a pixel fires no events for a time after an event
    shot_noise.py     events of either sign, most in the dark
    dead_pixels.py    pixels that never fire
    state.py          inputs of an effect
    kernel.py         the general kernel: all effects, and events with times

An effect is one field of the recipe (``v2v_protocol.recipe``: its limits, its unit, its stream of draws, and the most
that it does) and one file here, named in :data:`EFFECTS`. The file states the equation, its source, and

    FIELD                     the recipe's field
    ROWS                      the number of rows of a block's state that it needs
    NOISE                     whether it fires where nothing moves: a value in Hz is then the rate
    PURPOSES                  purposes of its words of noise (``noise.py``), numbers that no other effect has; if any
    PANEL                     the panel of ``v2v-fit`` that shows it: "rates", "still", "pixels" or "intervals"
    prepare(value, clip)      its tables; for the value 0 they have the same types and switch everything off

and, compiled, any of these functions. Each does nothing if the tables say off:

    start(tables, own, block, at)     before the first step of a block of pixels; may change the block's thresholds
    see(tables, own, block, at)       may replace ``block.change``, the change of log intensity in this step
    change(tables, own, block, at)    may add to ``block.change``
    divide(tables, own, block, at)    may divide the step into legs, ``block.legs`` and ``block.shares``; then it
                                      returns True
    cross(tables, own, block, at)     may decide ``block.residual`` and the events itself: ``block.rises``,
                                      ``block.falls`` and, for their times, ``block.signed``; then it returns True
    after(tables, own, block, at)     may change ``block.rises`` and ``block.falls``, the events, and ``block.residual``

Within a step: see, noise, change, hot drift, divide; then, once or for each leg, cross and after. Effects run in the
order of :data:`EFFECTS`. The names of ``block`` and ``at`` are in :mod:`v2v_server.simulation.effects.state`.
``docs/effects.md`` gives sources, differences from them, and values; ``docs/extending.md`` shows how to add an effect.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_server.simulation import noise
from v2v_server.simulation.effects.state import Clip
from v2v_server.simulation.intensity import Intensity, linear_light
from v2v_server.simulation.precision import Real

EFFECTS: tuple[Any, ...] = tuple(
    import_module(f"{__name__}.{name}")
    for name in (
        "mismatch",
        "photoreceptor",
        "leak",
        "noise_band",
        "refractory",
        "shot_noise",
        "dead_pixels",
    )
)
"""All effects, in the order in which they run."""
NOISE = tuple(effect.FIELD for effect in EFFECTS if effect.NOISE)
"""Fields of the effects that fire where nothing moves."""


def prepare(
    values: Mapping[str, float],
    key: noise.NoiseKey,
    intensity: Intensity,
    step_seconds: npt.NDArray[np.float64],
    pixels: int,
    real: Real,
    thresholds: tuple[float, float],
    first: int = 0,
) -> tuple[Any, ...]:
    """Return the tables of every effect for one clip, in the order of :data:`EFFECTS`.

    Args:
        values: the draw, by field; missing fields are off.
        key: key of the sample's noise.
        intensity: of the grey levels.
        step_seconds: [steps] duration of each step, which is a segment (``voxel.Timeline``).
        pixels: number of pixels of the picture.
        real: arithmetic of the pixels, float32 or float64.
        thresholds: nominal ones, positive and negative, log units.
        first: number of the first step; above 0 for a clip that continues another one.

    Raises:
        UsageError: more shot events in a step than can be drawn, or noise of a band without a corner.
    """
    durations, table_of_step = np.unique(step_seconds, return_inverse=True)
    clip = Clip(
        linear_light(*intensity), step_seconds, durations, table_of_step.astype(np.int64), pixels, real, key, values,
        thresholds, first,
    )  # fmt: skip
    return tuple(effect.prepare(values.get(effect.FIELD, 0.0), clip) for effect in EFFECTS)
