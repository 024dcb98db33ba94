"""List the results of the V2V paper: MSE, SSIM of range 2, LPIPS of AlexNet, each the mean over sequences."""

from __future__ import annotations

_METRICS = ("mse", "ssim_range2", "lpips_alex")
"""Names of the paper's three columns in this project."""

_DATA_SETS = ("HQF", "EVAID", "IJRR", "MVSEC")

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
        data_set: dict(zip(_METRICS, triple, strict=True)) for data_set, triple in zip(_DATA_SETS, triples, strict=True)
    }
    for method, triples in _TABLE.items()
}
"""``RESULTS[method][data set][metric]``."""

FLOW_SEQUENCES = ("indoor_flying1", "indoor_flying2", "indoor_flying3", "outdoor_day1", "outdoor_day2")

_FLOW_TABLE: dict[str, tuple[tuple[float, float, float, float], ...]] = {
    "Zeros": (
        (1.772, 2.041, 14.5, 20.2), (2.705, 3.463, 36.1, 52.5), (2.412, 2.772, 30.2, 38.6), (3.985, 3.585, 57.1, 54.5),
        (2.793, 2.562, 32.9, 31.7),
    ),
    "EvFlow+": (
        (0.967, 0.752, 2.7, 0.8), (1.154, 0.990, 5.4, 2.4), (1.184, 0.833, 7.0, 1.6), (2.903, 1.445, 36.1, 12.1),
        (1.983, 1.580, 19.8, 14.4),
    ),
    "EVFlowNet WebVid10K": (
        (0.732, 0.745, 0.5, 0.5), (0.870, 0.990, 1.3, 2.3), (0.741, 0.758, 0.4, 0.6), (2.114, 1.191, 23.6, 8.4),
        (1.627, 1.365, 15.0, 11.2),
    ),
}  # fmt: skip

FLOW: dict[str, dict[str, dict[str, float]]] = {
    method: {
        sequence: dict(zip(("aee_dense", "aee_sparse", "3pe_dense", "3pe_sparse"), values, strict=True))
        for sequence, values in zip(FLOW_SEQUENCES, rows, strict=True)
    }
    for method, rows in _FLOW_TABLE.items()
}
"""``FLOW[method][sequence][metric]``, in the published convention: see :mod:`trainer.evaluation.flow`."""
