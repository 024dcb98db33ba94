"""Convert grey levels to log intensity, and to light.

    L(F) = log(log_eps + (F / 255) ** gamma)            natural logarithm; paper section 3

The reverse gamma correction undoes the camera's response curve. The epsilon is the dark floor that keeps the logarithm
finite: the dark current of a pixel as a share of white's photocurrent. Logarithm and exponential are implemented here,
so every host has the same tables.
"""

from __future__ import annotations

import decimal
import functools
from typing import Any

import numpy as np
import numpy.typing as npt

from v2v_server.simulation.voxel import FINE_STEPS

Doubles = npt.NDArray[np.float64]

_LOG2_E, _LN2_HIGH, _LN2_LOW = 1.4426950408889634, 6.93147180369123816490e-01, 1.90821492927058770002e-10
_EXP_DEGREE = 14


@functools.lru_cache(maxsize=64)
def log_table(gamma: float, log_eps: float) -> npt.NDArray[np.float32]:
    """Return L of every grey level.

    Computed in decimal arithmetic of 50 digits and then rounded once, because the logarithm of a maths library may
    differ in its last bit from host to host.

    Args:
        gamma: exponent of the reverse gamma correction.
        log_eps: epsilon inside the logarithm, > 0.

    Returns:
        [256] float32, read-only, log-intensity units, increasing.
    """
    table = log_table_float64(gamma, log_eps).astype(np.float32)
    table.setflags(write=False)
    return table


@functools.lru_cache(maxsize=64)
def log_table_float64(gamma: float, log_eps: float) -> Doubles:
    """Return L of every grey level, [256] float64, read-only."""
    with decimal.localcontext(decimal.Context(prec=50)):
        exponent, floor = decimal.Decimal(gamma), decimal.Decimal(log_eps)
        levels = [(floor + (decimal.Decimal(level) / 255) ** exponent if level else floor).ln() for level in range(256)]
    table = np.array([float(level) for level in levels])
    table.setflags(write=False)
    return table


def fine_table(table: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return L of grey levels in 1/FINE_STEPS, linear between grey levels.

    Args:
        table: [256] float32 or float64, L of grey levels; empty (no grey levels) gives an empty table.

    Returns:
        [255 FINE_STEPS + 1], of the same type.
    """
    if not len(table):
        return table
    grey, part = np.divmod(np.arange(255 * FINE_STEPS + 1), FINE_STEPS)
    rise = np.append(np.diff(table), table.dtype.type(0))
    fine: npt.NDArray[Any] = table[grey] + rise[grey] * (part.astype(table.dtype) / table.dtype.type(FINE_STEPS))
    return fine


def linear_light(gamma: float, log_eps: float) -> Doubles:
    """Return i(F) = (F / 255) ** gamma of every grey level, [256] float64 from 0 (black) to 1 (white)."""
    return np.clip(exponential(log_table_float64(gamma, log_eps)) - log_eps, 0.0, 1.0)


def exponential(x: Doubles) -> Doubles:
    """Return e ** x to a few units in the last place.

    x = n ln 2 + r, |r| <= ln 2 / 2, and the Taylor series of e ** r (degree 14, truncated below 1e-18).
    """
    x = np.maximum(x, -700.0)
    whole = np.floor(x * _LOG2_E + 0.5)
    rest = (x - whole * _LN2_HIGH) - whole * _LN2_LOW
    sum_ = np.ones_like(rest)
    for k in range(_EXP_DEGREE, 0, -1):
        sum_ = 1.0 + sum_ * rest / k
    return np.ldexp(sum_, whole.astype(np.int64))
