"""From grey level to log intensity.

    L(F) = log(log_eps + (F / 255) ** gamma)            natural logarithm; paper section 3

The camera's response curve is undone by the reverse gamma correction; the epsilon is the dark floor that keeps the
logarithm finite.
"""

from __future__ import annotations

import decimal
import functools

import numpy as np
import numpy.typing as npt


@functools.lru_cache(maxsize=64)
def log_table(gamma: float, log_eps: float) -> npt.NDArray[np.float32]:
    """L of every grey level.

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
def log_table_float64(gamma: float, log_eps: float) -> npt.NDArray[np.float64]:
    """The same, [256] float64, read-only."""
    with decimal.localcontext(decimal.Context(prec=50)):
        exponent, floor = decimal.Decimal(gamma), decimal.Decimal(log_eps)
        levels = [(floor + (decimal.Decimal(level) / 255) ** exponent if level else floor).ln() for level in range(256)]
    table = np.array([float(level) for level in levels])
    table.setflags(write=False)
    return table
