"""The definition of the random numbers in ``v2v_server/simulation/noise.py``, all at a time in numpy: words, noise,
starts of the residuals, mismatch, and what decides shot events; and how far the roundings of the kernel reach.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from v2v_server.simulation import noise
from v2v_server.simulation.effects import mismatch, shot_noise
from v2v_server.simulation.precision import Real


def scramble(x: noise.Words) -> noise.Words:
    """Apply S: a bijection of 32-bit words, three multiplications."""
    x = x ^ (x >> np.uint32(17))
    x = x * noise.SCRAMBLE_FACTORS[0]
    x = x ^ (x >> np.uint32(11))
    x = x * noise.SCRAMBLE_FACTORS[1]
    x = x ^ (x >> np.uint32(15))
    x = x * noise.SCRAMBLE_FACTORS[2]
    return x ^ (x >> np.uint32(14))


def mix(z: noise.Words, angle_word: noise.Words) -> tuple[noise.Words, noise.Words]:
    """Return x and y of that module's docstring, from the exclusive or of the two radius words and of the two angle
    words.
    """
    x = z ^ (z >> np.uint32(16))
    x = x * noise.MIX_FACTORS[0]
    x = x ^ (x >> np.uint32(15))
    x = x * noise.MIX_FACTORS[1]
    return x, (x ^ (x >> np.uint32(15)) ^ angle_word) * noise.MIX_FACTORS[2]


def words(key: noise.NoiseKey, purpose: int, counter: npt.ArrayLike) -> noise.Words:
    """Return word(purpose, n) of each counter n.

    Args:
        key: four words, 0 .. 2**32 - 1.
        purpose: a constant of ``noise.py``.
        counter: any shape, 0 .. 2**32 - 1.

    Returns:
        the counter's shape (at least one dimension), uint32.
    """
    word = scramble(np.atleast_1d(np.asarray(counter)).astype(np.uint32) + fold(key, 2 * purpose))
    return scramble(word + fold(key, 2 * purpose + 1))


def fold(key: noise.NoiseKey, constant: int) -> noise.Words:
    """Return a word of the whole key: [1] uint32."""
    word = scramble(np.array([constant * int(noise.GOLDEN) % 2**32], np.uint32))
    for part in key:
        word = scramble(word + np.uint32(part))
    return word


def standard_normals(key: noise.NoiseKey, steps: int, pixels: int) -> noise.Reals:
    """Return the noise of every step, before it is scaled.

    Returns:
        [steps, pixels] float32; steps counted from 0 (the step from frame 0 to frame 1), pixels in row order.
    """
    pairs = (steps + 1) // 2
    place = np.arange(pixels)
    radius_words, angle_words = words(key, noise.PIXEL_RADIUS, place), words(key, noise.PIXEL_ANGLE, place)
    pair_radius, pair_angle = (
        words(key, noise.PAIR_RADIUS, np.arange(pairs)),
        words(key, noise.PAIR_ANGLE, np.arange(pairs)),
    )
    normals = np.empty((2 * pairs, pixels), np.float32)
    for pair in range(pairs):
        x, y = mix(radius_words ^ pair_radius[pair], angle_words ^ pair_angle[pair])
        normals[2 * pair], normals[2 * pair + 1] = noise.box_muller(x, y)
    return normals[:steps]


def start_uniforms(key: noise.NoiseKey, pixels: int) -> noise.Reals:
    """Return the start of each pixel's residual between -threshold_neg (0) and +threshold_pos (1): [pixels] float32 in
    [0, 1), multiples of 2**-24.
    """
    return (words(key, noise.START, np.arange(pixels)) >> np.uint32(8)).astype(np.float32) * np.float32(2.0**-24)


def shot_words(key: noise.NoiseKey, steps: int, pixels: int) -> tuple[noise.Words, noise.Words]:
    """Return independent uniform words that decide the shot events: those of positive and of negative events.

    ``mix`` of the words of pixel and step, as for the normals: with PIXEL_POS and STEP_POS in the place of the two
    radius words, PIXEL_NEG and STEP_NEG in that of the two angle words.

    Returns:
        each [steps, pixels] uint32.
    """
    place, step = np.arange(pixels), np.arange(steps)
    positive = words(key, shot_noise.STEP_POS, step)[:, None] ^ words(key, shot_noise.PIXEL_POS, place)
    return mix(positive, words(key, shot_noise.STEP_NEG, step)[:, None] ^ words(key, shot_noise.PIXEL_NEG, place))


def error_bound(real: Real, events: float, smaller_threshold: float) -> float:
    """Return the largest error of a pixel's events and residual, log units, given exact change and noise."""
    return 4.0 * float(np.finfo(real).eps) * events * smaller_threshold


def mismatch_normals(key: noise.NoiseKey, pixels: int) -> tuple[noise.Reals, noise.Reals]:
    """Return each pixel's deviation of its positive and negative threshold, in standard deviations: two of [pixels]
    float32.
    """
    place = np.arange(pixels)
    return noise.box_muller(*mix(words(key, mismatch.RADIUS, place), words(key, mismatch.ANGLE, place)))
