"""Linear light, and an exponential by sums and products in float64, so that every host has the same tables."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from v2v_server.simulation.intensity import log_table_float64

Doubles = npt.NDArray[np.float64]

_LOG2_E, _LN2_HIGH, _LN2_LOW = 1.4426950408889634, 6.93147180369123816490e-01, 1.90821492927058770002e-10
_EXP_DEGREE = 14


def linear_light(gamma: float, log_eps: float) -> Doubles:
    """i(F) = (F / 255) ** gamma of every grey level, [256] float64 from 0 (black) to 1 (white)."""
    return np.clip(exponential(log_table_float64(gamma, log_eps)) - log_eps, 0.0, 1.0)


def exponential(x: Doubles) -> Doubles:
    """e ** x to a few units in the last place.

    x = n ln 2 + r, |r| <= ln 2 / 2, and the Taylor series of e ** r (degree 14, truncated below 1e-18).
    """
    x = np.maximum(x, -700.0)
    whole = np.floor(x * _LOG2_E + 0.5)
    rest = (x - whole * _LN2_HIGH) - whole * _LN2_LOW
    sum_ = np.ones_like(rest)
    for k in range(_EXP_DEGREE, 0, -1):
        sum_ = 1.0 + sum_ * rest / k
    return np.ldexp(sum_, whole.astype(np.int64))
