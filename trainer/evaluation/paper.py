"""Results that the V2V paper states: MSE, SSIM of range 2, LPIPS of AlexNet, each the mean over sequences."""

from __future__ import annotations

METRICS = ("mse", "ssim_range2", "lpips_alex")
"""Names here of the paper's three columns."""

DATA_SETS = ("HQF", "EVAID", "IJRR", "MVSEC")

Triple = tuple[float, float, float]

_TABLE: dict[str, tuple[Triple, Triple, Triple, Triple]] = {
    "E2VID+": ((0.037, 0.638, 0.256), (0.088, 0.526, 0.469), (0.063, 0.556, 0.238), (0.132, 0.340, 0.506)),
    "E2VID WebVid100": ((0.042, 0.626, 0.327), (0.078, 0.594, 0.441), (0.067, 0.550, 0.278), (0.076, 0.385, 0.525)),
    "E2VID WebVid1K": ((0.037, 0.661, 0.286), (0.072, 0.627, 0.405), (0.078, 0.569, 0.251), (0.103, 0.360, 0.509)),
    "E2VID WebVid10K": ((0.032, 0.676, 0.265), (0.054, 0.663, 0.371), (0.070, 0.562, 0.248), (0.066, 0.406, 0.465)),
    "E2VID WebVid10K, fixed thresholds": (
        (0.032, 0.666, 0.264), (0.058, 0.644, 0.378), (0.086, 0.539, 0.256), (0.097, 0.370, 0.492)
    ),
    "E2VID WebVid10K, AlexNet and full temporal loss": (
        (0.034, 0.652, 0.249), (0.054, 0.604, 0.388), (0.082, 0.519, 0.268), (0.088, 0.375, 0.453)
    ),
    "E2VID WebVid10K, filtered list": (
        (0.038, 0.662, 0.275), (0.059, 0.645, 0.389), (0.069, 0.574, 0.238), (0.072, 0.398, 0.468)
    ),
    "E2VID WebVid10K, contrast degraded": (
        (0.034, 0.647, 0.287), (0.090, 0.565, 0.440), (0.092, 0.560, 0.265), (0.092, 0.386, 0.480)
    ),
    "E2VID ESIM, interpolated": (
        (0.041, 0.599, 0.306), (0.078, 0.526, 0.478), (0.061, 0.561, 0.258), (0.127, 0.324, 0.490)
    ),
    "E2VID ESIM, discrete": (
        (0.040, 0.608, 0.296), (0.062, 0.548, 0.450), (0.060, 0.570, 0.255), (0.125, 0.345, 0.494)
    ),
    "HyperE2VID": ((0.032, 0.646, 0.265), (0.071, 0.533, 0.474), (0.036, 0.624, 0.227), (0.070, 0.419, 0.473)),
    "HyperE2VID WebVid10K": (
        (0.035, 0.671, 0.269), (0.055, 0.654, 0.377), (0.059, 0.600, 0.231), (0.077, 0.340, 0.570)
    ),
    "ETNet": ((0.035, 0.642, 0.274), (0.080, 0.541, 0.523), (0.049, 0.590, 0.236), (0.111, 0.360, 0.491)),
    "ETNet WebVid10K": ((0.036, 0.662, 0.279), (0.081, 0.586, 0.432), (0.089, 0.549, 0.256), (0.106, 0.355, 0.506)),
}  # fmt: skip

RESULTS: dict[str, dict[str, dict[str, float]]] = {
    method: {
        data_set: dict(zip(METRICS, triple, strict=True)) for data_set, triple in zip(DATA_SETS, triples, strict=True)
    }
    for method, triples in _TABLE.items()
}
"""``RESULTS[method][data set][metric]``."""
