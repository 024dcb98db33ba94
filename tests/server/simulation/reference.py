"""The kernel's float32 definition in numpy, whole pictures at a time: what the kernel must equal bit for bit."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from tests.oracles.noise import mismatch_normals, shot_words, standard_normals, start_uniforms
from v2v_server.simulation import noise
from v2v_server.simulation.effects import EFFECTS
from v2v_server.simulation.pixel import hot_pixels
from v2v_server.simulation.voxel import LARGEST_COUNT, rounding_tolerance


def simulate(
    level: npt.NDArray[Any],
    key: noise.NoiseKey,
    *,
    threshold_pos: float,
    threshold_neg: float,
    noise_scale: npt.NDArray[Any] | None,
    hot_count: int,
    hot_sigma: float,
    hot_scale: npt.NDArray[Any],
    frames_per_bin: int,
    dtype: str,
) -> tuple[npt.NDArray[Any], int]:
    """Voxels [steps / frames_per_bin, pixels] and saturated bins.

    Args:
        level: [steps + 1, pixels] log intensity, float32 or float64: the arithmetic of everything but the noise.
        key: the noise key.
        noise_scale: [steps], or None for no noise.
        hot_count, hot_sigma, hot_scale: hot pixels, their deviation, and [steps] durations.
    """
    real = level.dtype.type
    steps, pixels = len(level) - 1, level.shape[1]
    positive, negative = real(threshold_pos), real(threshold_neg)
    tolerance = real(rounding_tolerance(threshold_pos, threshold_neg))
    residual = start_uniforms(key, pixels).astype(real) * (positive + negative) - negative
    normals = None if noise_scale is None else standard_normals(key, steps, pixels)
    position, normal = hot_pixels(key, hot_count, pixels)
    drift = normal.astype(real) * real(hot_sigma)
    counts = np.zeros((steps // frames_per_bin, pixels), real)
    for step in range(steps):
        residual[position] += drift * real(hot_scale[step])
        change = level[step + 1] - level[step]
        if normals is not None and noise_scale is not None:
            change += normals[step].astype(real) * real(noise_scale[step])
        potential = residual + change
        threshold = np.where(potential >= 0, positive, negative)
        events = np.floor((np.abs(potential) + tolerance) / threshold)
        signed = np.where(potential >= 0, events, -events)
        residual = potential - signed * threshold
        counts[step // frames_per_bin] += signed
    clipped = np.clip(counts, -real(LARGEST_COUNT[dtype]), real(LARGEST_COUNT[dtype]))
    return clipped.astype(dtype), int(np.count_nonzero(clipped != counts))


def simulate_with_effects(
    grey: npt.NDArray[np.uint8],
    table: npt.NDArray[Any],
    prepared: tuple[Any, ...],
    key: noise.NoiseKey,
    *,
    threshold_pos: float,
    threshold_neg: float,
    tolerance: float,
    noise_sigma: float,
    hot_count: int,
    hot_sigma: float,
) -> npt.NDArray[Any]:
    """Signed events of every step [steps, pixels], one frame a unit of noise, in the arithmetic of ``table``.

    Args:
        grey: [steps + 1, pixels].
        table: [256] log intensity of each grey level.
        prepared: the effects' tables.
    """
    of = {effect.FIELD: tables for effect, tables in zip(EFFECTS, prepared, strict=True)}
    (sigma, smallest_share), (low_pass, table_of_step) = of["threshold_mismatch_sigma"], of["photoreceptor_hz"]
    leak, (refractory, seconds), shot = of["leak_hz"], of["refractory_seconds"], of["shot_noise_hz"]
    real = table.dtype.type
    steps, pixels = len(grey) - 1, grey.shape[1]
    level, tolerance = table[grey], real(tolerance)
    normal = np.stack(mismatch_normals(key, pixels)).astype(real)
    share = np.maximum(real(1) + normal * sigma, smallest_share)
    positive, negative = real(threshold_pos) * share[0], real(threshold_neg) * share[1]
    residual = start_uniforms(key, pixels).astype(real) * (positive + negative) - negative
    normals = standard_normals(key, steps, pixels)
    position, normal = hot_pixels(key, hot_count, pixels)
    decided = shot_words(key, steps, pixels)
    seen, blind = level[0].copy(), np.zeros(pixels, real)
    counts = np.zeros((steps, pixels), real)
    for step in range(steps):
        change = level[step + 1] - level[step]
        of_step = table_of_step[step]
        if len(low_pass):
            slow, fast = low_pass[of_step][:, grey[step + 1]]
            change = slow * (level[step] - seen) + fast * change
            seen += change
        if noise_sigma:
            change += normals[step].astype(real) * real(noise_sigma)
        if len(leak):
            change += positive * leak[step]
        change[position] += normal.astype(real) * real(hot_sigma)
        if refractory > 0:
            signed, residual, blind = _with_refractory(
                residual, blind, change, seconds[step], refractory, positive, negative,
                tolerance,
            )  # fmt: skip
        else:
            potential = residual + change
            threshold = np.where(potential >= 0, positive, negative)
            events = np.floor((np.abs(potential) + tolerance) / threshold)
            signed = np.where(potential >= 0, events, -events)
            residual = potential - signed * threshold
        if len(shot.shot):
            chances = shot.shot.view(np.uint32)[of_step][:, grey[step + 1]]
            rising, falling = ((words[step] < chances).sum(axis=0) for words in decided)
            signed = signed + (rising - falling).astype(real)
            residual = np.where(rising + falling > 0, real(0), residual)
        counts[step] = signed
    counts[:, of["dead_pixel_share"][0]] = 0
    return counts


def _with_refractory(
    residual: npt.NDArray[Any],
    blind: npt.NDArray[Any],
    change: npt.NDArray[Any],
    seconds: Any,
    refractory: Any,
    positive: npt.NDArray[Any],
    negative: npt.NDArray[Any],
    tolerance: Any,
) -> tuple[npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any]]:
    zero = type(seconds)(0)
    potential = residual + change * (np.maximum(seconds - blind, zero) / seconds)
    threshold = np.where(potential >= 0, positive, negative)
    size, speed = np.abs(potential), np.abs(change)
    missed = speed * (refractory / seconds)
    period = threshold + missed
    more = np.floor((size - threshold + tolerance) / period)
    left = (size - threshold) - more * period
    fires, is_blind = size + tolerance >= threshold, left < missed
    sign = np.where(potential >= 0, type(seconds)(1), type(seconds)(-1))
    with np.errstate(divide="ignore", invalid="ignore"):
        rest = np.minimum(refractory - left * (seconds / speed), refractory)
    return (
        np.where(fires, sign * (more + 1), zero),
        np.where(fires, np.where(is_blind, zero, sign * (left - missed)), potential),
        np.where(fires, np.where(is_blind, rest, zero), np.maximum(blind - seconds, zero)),
    )
