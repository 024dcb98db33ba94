"""The balance of every pixel of a simulated clip: its events against the changes that caused them.

    threshold_pos sum N+  -  threshold_neg sum N-   =   change of log intensity + noise + drift - change of residual

The kernel does not show its residual, so ``dense.trace`` goes through the clip again, in the arithmetic the kernel
chose, and has to come to the very same counts. Its residual closes the balance. The right side is summed without error:
log intensities cancel but for the first and last, thresholds and counts multiply as fractions, normals add by ``fsum``.
What is left must be below ``noise.error_bound``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt

from tests.oracles.dense import Trace, trace
from tests.oracles.noise import error_bound, standard_normals, start_uniforms
from v2v_protocol.recipe import most_events
from v2v_server.simulation import simulate, simulate_log
from v2v_server.simulation.draw import noise_key_of_seed
from v2v_server.simulation.intensity import log_table, log_table_float64
from v2v_server.simulation.pixel import hot_pixels
from v2v_server.simulation.precision import AUTO, Real, choose, noise_sum
from v2v_server.simulation.voxel import rounding_tolerance
from v2v_server.video.picture import SDR, Signal


@dataclass(frozen=True)
class Camera:
    """Arguments of ``simulate``, in its units."""

    threshold_pos: float = 0.2
    threshold_neg: float = 0.25
    noise_sigma: float = 0.0
    hot_pixel_count: int = 0
    hot_pixel_sigma: float = 0.0
    gamma: float = 2.2
    log_eps: float = 1e-3
    seed: int = 0
    signal: Signal = SDR


@dataclass(frozen=True)
class Balance:
    """The imbalance of a clip, and its bounds.

    Attributes:
        real: the arithmetic.
        events: most events a pixel of this clip might have fired.
        fired: events that were fired.
        error: largest imbalance of a pixel, log units.
        bound: what the arithmetic allows, log units.
        beyond: how far a residual went beyond the thresholds, log units.
        differing: bins in which the kernel and the trace differ.
    """

    real: Real
    events: float
    fired: int
    error: float
    bound: float
    beyond: float
    differing: int

    @property
    def holds(self) -> bool:
        """Return whether no event is invented or lost, and every residual is below its threshold."""
        return self.differing == 0 and self.error <= self.bound and self.beyond <= self.bound


def balance(camera: Camera, frames: npt.NDArray[Any]) -> Balance:
    """Simulate a clip and compute its balance.

    Args:
        camera: the virtual camera.
        frames: [n, h, w] grey levels, uint8 or uint16, or floating point log intensities.

    Raises:
        UsageError: the simulation refuses the camera.
    """
    steps, pixels, grey = len(frames) - 1, frames[0].size, frames.dtype.kind == "u"
    real, events = arithmetic(camera, frames)
    settings: dict[str, Any] = {
        "threshold_pos": camera.threshold_pos, "threshold_neg": camera.threshold_neg,
        "noise_sigma": camera.noise_sigma, "hot_pixel_count": camera.hot_pixel_count,
        "hot_pixel_sigma": camera.hot_pixel_sigma, "seed": camera.seed, "frames_per_bin": 1, "dtype": "float32",
    }  # fmt: skip
    # A recipe has at most 1024 bins; the library has not, so a long clip may be one voxel.
    if grey:
        voxels = simulate(
            frames, bins=steps, gamma=camera.gamma, log_eps=camera.log_eps, bits=camera.signal.bits,
            transfer=camera.signal.transfer, **settings,
        ).voxels  # fmt: skip
    else:
        voxels = simulate_log(frames, bins=steps, **settings).voxels
    again = trace_of(camera, frames, real)
    differing = int(np.count_nonzero(voxels.reshape(steps, pixels) != again.counts.astype(np.float32)))
    tolerance = rounding_tolerance(camera.threshold_pos, camera.threshold_neg)
    beyond = max(again.residual_high - camera.threshold_pos, -again.residual_low - camera.threshold_neg) - tolerance
    return Balance(
        real, events, int(np.abs(again.counts.astype(np.float64)).sum()), imbalance(camera, frames, again),
        error_bound(real, events, min(camera.threshold_pos, camera.threshold_neg)), max(beyond, 0.0), differing,
    )  # fmt: skip


def arithmetic(camera: Camera, frames: npt.NDArray[Any]) -> tuple[Real, float]:
    """Return the arithmetic in which a clip is simulated, and ``most_events`` of it."""
    if frames.dtype.kind == "u":
        table = log_table_float64(camera.gamma, camera.log_eps, camera.signal)
        ends = float(table[0]), float(table[-1])
    else:
        ends = float(frames.min()), float(frames.max())
    steps = len(frames) - 1
    total = noise_sum(camera.noise_sigma, camera.hot_pixel_sigma if camera.hot_pixel_count else 0.0, np.ones(steps))
    events = most_events(steps, ends, (camera.threshold_pos, camera.threshold_neg), total)
    return choose(AUTO, events), events


def trace_of(camera: Camera, frames: npt.NDArray[Any], real: Real) -> Trace:
    """Follow the clip pixel by pixel in the given arithmetic."""
    steps, pixels, key = len(frames) - 1, frames[0].size, noise_key_of_seed(camera.seed)
    flat = frames.reshape(len(frames), pixels)
    if frames.dtype.kind == "u":
        table = log_table if real is np.float32 else log_table_float64
        levels: npt.NDArray[Any] = table(camera.gamma, camera.log_eps, camera.signal)[flat]
    else:
        levels = flat.astype(real)
    noisy = np.empty((0, 0), real)
    if camera.noise_sigma > 0.0:
        noisy = standard_normals(key, steps, pixels).astype(real) * real(camera.noise_sigma)
    hot = np.zeros(pixels, real)
    position, normal = hot_pixels(key, camera.hot_pixel_count, pixels)
    hot[position] = normal.astype(real) * real(camera.hot_pixel_sigma)
    positive, negative = real(camera.threshold_pos), real(camera.threshold_neg)
    start = start_uniforms(key, pixels).astype(real) * (positive + negative) - negative
    tolerance = rounding_tolerance(camera.threshold_pos, camera.threshold_neg)
    return trace(levels, noisy, hot, start, positive, negative, tolerance)


def imbalance(camera: Camera, frames: npt.NDArray[Any], seen: Trace) -> float:
    """Return the largest difference of the two sides of the balance, log units."""
    steps, pixels, key = len(frames) - 1, frames[0].size, noise_key_of_seed(camera.seed)
    ends = frames[[0, -1]].reshape(2, pixels)
    level = log_table_float64(camera.gamma, camera.log_eps, camera.signal)[ends] if frames.dtype.kind == "u" else ends
    normals = standard_normals(key, steps, pixels).astype(np.float64) if camera.noise_sigma else None
    position, hot_normal = hot_pixels(key, camera.hot_pixel_count, pixels)
    hot = np.zeros(pixels)
    hot[position] = hot_normal
    real = seen.counts.dtype.type
    positive, negative = Fraction(float(real(camera.threshold_pos))), Fraction(float(real(camera.threshold_neg)))
    largest = Fraction(0)
    for p in range(pixels):
        counts = seen.counts[:, p].astype(np.float64)
        fired = positive * int(math.fsum(counts[counts > 0])) + negative * int(math.fsum(counts[counts < 0]))
        expected = Fraction(float(level[1, p])) - Fraction(float(level[0, p]))
        expected += Fraction(float(seen.residual_start[p])) - Fraction(float(seen.residual_end[p]))
        expected += steps * Fraction(float(hot[p])) * Fraction(camera.hot_pixel_sigma)
        if normals is not None:
            expected += Fraction(math.fsum(normals[:, p])) * Fraction(camera.noise_sigma)
        largest = max(largest, abs(fired - expected))
    return float(largest)
