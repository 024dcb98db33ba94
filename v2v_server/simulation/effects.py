"""What a camera does beyond the paper's pixel model: the equations, and their tables.

Per pixel, in this order within a step of T seconds; i(F) = (F / 255) ** gamma is the light of grey level F, white = 1.
Each effect is off at zero. ``docs/effects.md`` tells sources, departures from them, and values.

Threshold mismatch s.  c+ (1 + s z+) and c- (1 + s z-), z Normal(0, 1), once per pixel and polarity, but no less
    than a quarter of the nominal threshold (Hu et al. 2021, v2e; measured by Lichtsteiner et al. 2008).

Photoreceptor low-pass of f_white Hz.  dP/dt = 2 pi f (L - P), f(F) = f_white (i + 20/255) / (1 + 20/255) of the new
    frame (v2e). L is linear between frames (ESIM: Rebecq et al. 2018), for which the step is exact:
        P' = P + a (L - P) + b (L' - L),    a = 1 - exp(-2 pi f T),    b = 1 - a / (2 pi f T)
    P takes the place of L in all that follows. It starts settled.

Leak of R events a second.  R c+ T of the pixel's own c+ are added to the change: positive events (v2e).

Refractory period t.  After an event the pixel is blind for t seconds; what changes meanwhile is lost (v2e drops the
    events of that time). With a change that is linear within the step, k events take the time to the first threshold
    plus (k - 1) (c / slope + t), and the blind time left over goes on into the next step.

Shot noise of R events a second.  Positive and negative events are two Poisson processes of rate R/2 (1 - 3/4 i(F)), F
    the new frame (v2e). They come on top of the step's events, and the pixel starts afresh from what it sees: its
    residual becomes 0 (v2e).

Dead pixels.  Never fire. Chosen like the hot ones.

Exponentials are our own: sums and products in float64, so every host has the same tables.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import UsageError
from v2v_protocol.recipe import SMALLEST_THRESHOLD_SHARE
from v2v_protocol.sample import SampleParams
from v2v_server.simulation import noise
from v2v_server.simulation.intensity import log_table_float64
from v2v_server.simulation.precision import Real

Reals = npt.NDArray[Any]
Doubles = npt.NDArray[np.float64]

DARKEST = 20 / 255
"""v2e's offset of the light that sets the bandwidth: no pixel is slower than 1/14 of a white one."""
WHITE_SHOT_NOISE = 0.25
"""Shot noise of a white pixel as a share of a black one's (v2e)."""
LARGEST_SHOT_MEAN = 64.0
"""Most shot events of one polarity that a step may hold on average."""

_LOG2_E, _LN2_HIGH, _LN2_LOW = 1.4426950408889634, 6.93147180369123816490e-01, 1.90821492927058770002e-10
_EXP_DEGREE = 14


class Prepared(NamedTuple):
    """The effects of one clip, ready for ``effect_pixel.simulate_pixels_with_effects``.

    Attributes:
        mismatch_sigma, smallest_share: real, of the nominal thresholds.
        low_pass: [tables, 2, 256] real, a and b by grey level; no table where there is no low-pass.
        shot: [tables, most, 256] float32 whose bits are uint32: entry k is the chance of more than k events of one
            polarity, in units of 2**-32; no table where there is no shot noise.
        shot_largest: [tables, most] uint32, the largest of each 256.
        table_of_step: [steps] int64, which of the tables holds for the step's duration.
        leak: [steps] real, leak of each step in thresholds; empty for none.
        seconds: [steps] real, duration of each step.
        refractory_seconds: real.
        dead_position: [count] int64, ascending.
    """

    mismatch_sigma: Any
    smallest_share: Any
    low_pass: Reals
    shot: npt.NDArray[np.float32]
    shot_largest: npt.NDArray[np.uint32]
    table_of_step: npt.NDArray[np.int64]
    leak: Reals
    seconds: Reals
    refractory_seconds: Any
    dead_position: npt.NDArray[np.int64]


def prepare(
    params: SampleParams,
    intensity: tuple[float, float],
    step_seconds: Doubles,
    pixels: int,
    real: Real,
    words_of: noise.WordsOf = noise.words,
) -> Prepared:
    """Tables of a draw.

    Args:
        params: the draw.
        intensity: gamma and log_eps.
        step_seconds: [steps] duration of each step.
        pixels: of the picture.
        real: arithmetic of the pixels, float32 or float64.
        words_of: a faster ``noise.words`` where the caller has one.

    Raises:
        UsageError: more shot events in a step than can be drawn.
    """
    effects, light = params.effects, linear_light(*intensity)
    durations, table_of_step = np.unique(step_seconds, return_inverse=True)
    low_pass, shot = np.empty((0, 2, 256), real), np.empty((0, 0, 256), np.uint32)
    if effects.photoreceptor_hz > 0.0:
        low_pass = np.stack([low_pass_table(effects.photoreceptor_hz, light, each) for each in durations]).astype(real)
    if effects.shot_noise_hz > 0.0:
        shot = shot_table(shot_means(effects.shot_noise_hz, light, durations))
    return Prepared(
        mismatch_sigma=real(effects.threshold_mismatch_sigma),
        smallest_share=real(SMALLEST_THRESHOLD_SHARE),
        low_pass=low_pass,
        shot=shot.view(np.float32),
        shot_largest=shot.max(axis=2, initial=0),
        table_of_step=table_of_step.astype(np.int64),
        leak=(effects.leak_hz * step_seconds).astype(real) if effects.leak_hz > 0.0 else np.empty(0, real),
        seconds=step_seconds.astype(real),
        refractory_seconds=real(effects.refractory_seconds),
        dead_position=noise.dead_pixels(params.noise_key, effects.dead_pixel_count, pixels, words_of),
    )


def linear_light(gamma: float, log_eps: float) -> Doubles:
    """i(F) of every grey level, [256] float64 from 0 (black) to 1 (white)."""
    return np.clip(exponential(log_table_float64(gamma, log_eps)) - log_eps, 0.0, 1.0)


def low_pass_table(photoreceptor_hz: float, light: Doubles, seconds: float) -> Doubles:
    """a and b of a step of that duration, [2, 256] float64."""
    turns = 2.0 * np.pi * photoreceptor_hz * seconds * ((light + DARKEST) / (1.0 + DARKEST))
    a = 1.0 - exponential(-turns)
    return np.stack([a, 1.0 - a / turns])


def shot_means(shot_noise_hz: float, light: Doubles, durations: Doubles) -> Doubles:
    """Mean events of one polarity: [durations, 256].

    Raises:
        UsageError: more than LARGEST_SHOT_MEAN.
    """
    means = 0.5 * shot_noise_hz * durations[:, None] * (1.0 - (1.0 - WHITE_SHOT_NOISE) * light)
    if means.max() > LARGEST_SHOT_MEAN:
        raise UsageError(
            f"shot noise of {shot_noise_hz:.6g} events a second makes {means.max():.4g} events of a polarity in a step "
            f"of {durations[-1]:.6g} s; the limit is {LARGEST_SHOT_MEAN:.0f}: lower shot_noise_hz, or take a video of "
            "more frames a second"
        )
    return means


def shot_table(means: Doubles) -> npt.NDArray[np.uint32]:
    """The chance of more than k Poisson events in units of 2**-32: [tables, most, 256], k = 0, 1 ... as far as it is
    not 0 in those units."""
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


def exponential(x: Doubles) -> Doubles:
    """e ** x to a few units in the last place, by sums and products alone: the same bits on every host.

    x = n ln 2 + r, |r| <= ln 2 / 2, and the Taylor series of e ** r (degree 14, truncated below 1e-18).
    """
    x = np.maximum(x, -700.0)
    whole = np.floor(x * _LOG2_E + 0.5)
    rest = (x - whole * _LN2_HIGH) - whole * _LN2_LOW
    sum_ = np.ones_like(rest)
    for k in range(_EXP_DEGREE, 0, -1):
        sum_ = 1.0 + sum_ * rest / k
    return np.ldexp(sum_, whole.astype(np.int64))
