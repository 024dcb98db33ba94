"""The kernel with a cheaper noise: the sum of 8 bytes instead of Box and Muller's transform.

Eight independent bytes sum up to a nearly normal number (Irwin and Hall): right mean and variance, excess kurtosis
-0.15, nothing beyond 4.9 standard deviations. The loops are the product's own, compiled with another generator in the
place of theirs, so that nothing else differs. Only for measuring: no stream can be asked for it.
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

import types
from collections.abc import Callable
from functools import cache
from typing import Any

import numba
import numpy as np
import numpy.typing as npt

from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import SampleParams
from v2v_server.simulation import noise
from v2v_server.simulation.intensity import log_table
from v2v_server.simulation.pixel import BLOCK_PX, simulate_pixels
from v2v_server.simulation.voxel import LARGEST_COUNT, rounding_tolerance, voxel_array

Kernel = Callable[..., int]

_M0, _M1, _M2 = noise.MIX_FACTORS
_GENERATOR = "two_normals"
_PAIRS = np.uint32(0x00FF00FF)
_MEAN = np.float32(8 * 255 / 2)
_SCALE = np.float32(1 / np.sqrt(8 * (256**2 - 1) / 12))


@numba.njit(nogil=True)
def sum_of_bytes(x, y):
    """A nearly standard normal number of two words, float32."""
    lanes = (x & _PAIRS) + ((x >> np.uint32(8)) & _PAIRS) + (y & _PAIRS) + ((y >> np.uint32(8)) & _PAIRS)
    total = np.uint32((lanes & np.uint32(0xFFFF)) + (lanes >> np.uint32(16)))
    return (np.float32(np.int32(total)) - _MEAN) * _SCALE


@numba.njit(nogil=True, inline="always")
def _two_sums(radius_words, angle_words, radius_word, angle_word, x_row, y_row, radius_row, normal):
    for i in range(BLOCK_PX):
        x = np.uint32(radius_words[i] ^ radius_word)
        x = np.uint32(x ^ (x >> np.uint32(16)))
        x = np.uint32(x * _M0)
        x = np.uint32(x ^ (x >> np.uint32(15)))
        x = np.uint32(x * _M1)
        y = np.uint32(np.uint32(x ^ (x >> np.uint32(15))) ^ np.uint32(angle_words[i] ^ angle_word))
        y = np.uint32(y * _M2)
        x_row[i] = np.uint32(x ^ (x >> np.uint32(15)))
        y_row[i] = np.uint32(y ^ (y >> np.uint32(16)))
    for i in range(BLOCK_PX):
        normal[0, i] = sum_of_bytes(x_row[i], y_row[i])
    for i in range(BLOCK_PX):
        x = np.uint32(np.uint32(y_row[i] * _M0) ^ x_row[i])
        x = np.uint32(np.uint32(x ^ (x >> np.uint32(15))) * _M1)
        x = np.uint32(x ^ (x >> np.uint32(15)))
        y = np.uint32(np.uint32(x + angle_words[i]) * _M2)
        normal[1, i] = sum_of_bytes(x, np.uint32(y ^ (y >> np.uint32(16))))


@cache
def cheap_kernel() -> Kernel:
    """``simulate_pixels`` with the cheap noise.

    Raises:
        RuntimeError: the kernel no longer calls its generator by the name that is replaced here.
    """
    plain = simulate_pixels.py_func
    if _GENERATOR not in plain.__code__.co_names:
        raise RuntimeError(f"v2v_server.simulation.pixel.simulate_pixels calls no {_GENERATOR}: adapt {__name__}")
    names = {**plain.__globals__, _GENERATOR: _two_sums}
    changed = types.FunctionType(plain.__code__, names, "simulate_pixels_cheaply")
    kernel: Kernel = numba.njit(nogil=True, error_model="numpy")(changed)
    return kernel


def run_kernel(
    kernel: Kernel, frames: npt.NDArray[np.uint8], params: SampleParams, recipe: Recipe
) -> npt.NDArray[np.float32]:
    """A sample's voxels [T, B, H, W] float32, made by a kernel of that form; noise per frame, no hot pixels."""
    steps, (_, height, width) = recipe.steps, frames.shape
    voxels: npt.NDArray[Any] = voxel_array(
        steps // (recipe.bins * recipe.frames_per_bin), recipe.bins, height, width, "float32"
    )
    threshold_pos, threshold_neg = np.float32(params.threshold_pos), np.float32(params.threshold_neg)
    kernel(
        np.ascontiguousarray(frames).reshape(len(frames), -1),
        log_table(recipe.gamma, recipe.log_eps[0]),
        params.source_index(steps),
        np.array(params.noise_key, np.uint32),
        np.full(steps if params.noise_sigma > 0.0 else 0, params.noise_sigma, np.float32),
        np.empty(0, np.int64),
        np.empty(0, np.float32),
        np.ones(steps, np.float32),
        threshold_pos,
        threshold_neg,
        np.float32(rounding_tolerance(params.threshold_pos, params.threshold_neg)),
        -threshold_neg,
        threshold_pos + threshold_neg,
        recipe.frames_per_bin,
        np.float32(LARGEST_COUNT["float32"]),
        voxels.reshape(steps // recipe.frames_per_bin, height * width),
    )
    return voxels
