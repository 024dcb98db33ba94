"""Resident memory over time, and the line through it.

The slope is that of ordinary least squares, with one intercept for every process that was measured (a server that was
killed and started again begins anew) and one slope for all:

    y_ij = a_i + b t_ij + e_ij

Points a second apart say nearly the same, so the textbook standard error would be far too small; it is widened by
sqrt((1 + r) / (1 - r)), with r the lag-one autocorrelation of the residuals (the effective number of samples of an
AR(1) process; von Storch and Zwiers, "Statistical Analysis in Climate Research", 1999, section 6.6).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import psutil

from v2v_protocol.errors import UsageError

MIB = float(1 << 20)
_MOST_AUTOCORRELATION = 0.99

Series = Sequence[tuple[float, float]]
"""(seconds, MiB) of one process."""


@dataclass(frozen=True, slots=True)
class Fit:
    """A line through memory over time.

    Attributes:
        slope: MiB a minute.
        standard_error: of the slope.
        autocorrelation: lag-one, of the residuals.
        residual: their standard deviation, MiB.
        points, series: how many of each were used.
        first, last, most: MiB at the beginning and end of the last series, and the most in any.
    """

    slope: float
    standard_error: float
    autocorrelation: float
    residual: float
    points: int
    series: int
    first: float
    last: float
    most: float

    def __str__(self) -> str:
        return (
            f"{self.slope:+.3f} +- {self.standard_error:.3f} MiB/min ({self.points} points, {self.series} processes, "
            f"residual {self.residual:.2f} MiB, autocorrelation {self.autocorrelation:.2f}); "
            f"{self.first:.1f} -> {self.last:.1f} MiB, at most {self.most:.1f}"
        )


def fit(series: Sequence[Series], *, skip_seconds: float = 0.0) -> Fit:
    """The common slope of several series.

    Args:
        series: of each process.
        skip_seconds: of the beginning of each one, while it warms up. Series of fewer than three points after that are
            left out.

    Raises:
        UsageError: no series is left.
    """
    used = []
    for each in series:
        points = np.array(each, dtype=np.float64).reshape(-1, 2)
        points = points[points[:, 0] - points[:1, 0] >= skip_seconds]
        if len(points) >= 3 and np.ptp(points[:, 0]) > 0:
            used.append(points)
    if not used:
        raise UsageError(
            f"no process was measured for three points after {skip_seconds:g} s of warm-up: run for longer"
        )
    centred = [points - points.mean(axis=0) for points in used]
    both = np.concatenate(centred)
    spread = float(both[:, 0] @ both[:, 0])
    slope = float(both[:, 0] @ both[:, 1]) / spread
    residuals = [points[:, 1] - slope * points[:, 0] for points in centred]
    error = np.concatenate(residuals)
    freedom = max(1, len(error) - len(used) - 1)
    variance = float(error @ error) / freedom
    r = _autocorrelation(residuals)
    widened = math.sqrt(variance / spread * (1 + r) / (1 - r))
    return Fit(
        slope=60.0 * slope,
        standard_error=60.0 * widened,
        autocorrelation=r,
        residual=math.sqrt(variance),
        points=len(error),
        series=len(used),
        first=float(used[-1][0, 1]),
        last=float(used[-1][-1, 1]),
        most=max(float(points[:, 1].max()) for points in used),
    )


def _autocorrelation(residuals: Sequence[npt.NDArray[np.float64]]) -> float:
    """Lag one, over all series; at least 0, because a negative one would narrow the error."""
    power = sum(float(each @ each) for each in residuals)
    lagged = sum(float(each[:-1] @ each[1:]) for each in residuals)
    return min(max(lagged / power, 0.0), _MOST_AUTOCORRELATION) if power > 0 else 0.0


def rss_mib(pid: int) -> float | None:
    """Resident memory of a process, MiB; None when it is gone (a zombie has none)."""
    try:
        resident = psutil.Process(pid).memory_info().rss
    except psutil.NoSuchProcess:
        return None
    return resident / MIB if resident else None
