"""The random numbers of the kernel, all at a time: noise, starts of the residuals, and what decides shot events."""

from __future__ import annotations

import numpy as np

from v2v_server.simulation import noise
from v2v_server.simulation.effects import shot_noise


def standard_normals(key: noise.NoiseKey, steps: int, pixels: int) -> noise.Reals:
    """Return the noise of every step, before it is scaled.

    Returns:
        [steps, pixels] float32; steps counted from 0 (the step from frame 0 to frame 1), pixels in row order.
    """
    pairs = (steps + 1) // 2
    place = np.arange(pixels)
    radius_words, angle_words = noise.words(key, noise.PIXEL_RADIUS, place), noise.words(key, noise.PIXEL_ANGLE, place)
    pair_radius, pair_angle = (
        noise.words(key, noise.PAIR_RADIUS, np.arange(pairs)),
        noise.words(key, noise.PAIR_ANGLE, np.arange(pairs)),
    )
    normals = np.empty((2 * pairs, pixels), np.float32)
    for pair in range(pairs):
        x, y = noise.mix(radius_words ^ pair_radius[pair], angle_words ^ pair_angle[pair])
        normals[2 * pair], normals[2 * pair + 1] = noise.box_muller(x, y)
    return normals[:steps]


def start_uniforms(key: noise.NoiseKey, pixels: int) -> noise.Reals:
    """Return the start of each pixel's residual between -threshold_neg (0) and +threshold_pos (1): [pixels] float32 in
    [0, 1), multiples of 2**-24.
    """
    return (noise.words(key, noise.START, np.arange(pixels)) >> np.uint32(8)).astype(np.float32) * np.float32(2.0**-24)


def shot_words(key: noise.NoiseKey, steps: int, pixels: int) -> tuple[noise.Words, noise.Words]:
    """Return independent uniform words that decide the shot events: those of positive and of negative events.

    ``mix`` of the words of pixel and step, as for the normals: with PIXEL_POS and STEP_POS in the place of the two
    radius words, PIXEL_NEG and STEP_NEG in that of the two angle words.

    Returns:
        each [steps, pixels] uint32.
    """
    place, step = np.arange(pixels), np.arange(steps)
    positive = noise.words(key, shot_noise.STEP_POS, step)[:, None] ^ noise.words(key, shot_noise.PIXEL_POS, place)
    return noise.mix(
        positive, noise.words(key, shot_noise.STEP_NEG, step)[:, None] ^ noise.words(key, shot_noise.PIXEL_NEG, place)
    )
