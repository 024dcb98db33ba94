"""Convert grey levels to log intensity, and to light.

    L(F) = log(log_eps + i(V)),  V = F / 255            natural logarithm; paper section 3
    i(V) = V ** gamma                                   SDR: undoes the camera's response curve

The epsilon is the dark floor that keeps the logarithm finite: the dark current of a pixel as a share of white's
photocurrent. A clip of b bits has V = F / (2**b - 1). Where a recipe uses the transfer that a video states:

    pq      i = 10000/203 (max(P - c1, 0) / (c2 - c3 P)) ** (1/m1),  P = V ** (1/m2)
            The EOTF of SMPTE ST 2084 and ITU-R BT.2100 (table 4), display light; m1 = 2610/16384, m2 = 2523/32,
            c1 = 107/128, c2 = 2413/128, c3 = 2392/128.
    hlg     i = E(V) / E(0.75),  E = V**2 / 3 for V <= 1/2, otherwise (exp((V - c) / a) + b) / 12
            The inverse OETF of ITU-R BT.2100 (table 5, ARIB STD-B67), scene light; a = 0.17883277, b = 1 - 4a,
            c = 1/2 - a ln(4a).
    log100  i = 10 ** (2 (V - 1)), log316  i = 10 ** (2.5 (V - 1)), linear  i = V      ITU-T H.273

i = 1 is white: of SDR the highest level, of PQ and HLG the reference white of ITU-R BT.2408, 203 cd/m2 and 75 %. PQ
reaches 49.3, HLG 3.77. The picture of such a clip, ``frames``, is tone mapped to what an SDR video of the same light
would show; it clips at white:

    F' = round(255 min(i(V), 1) ** (1/gamma))

Logarithm and exponential are implemented here, so every host has the same tables.
"""

from __future__ import annotations

import decimal
import functools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from v2v_server.simulation.voxel import FINE_STEPS
from v2v_server.video.picture import SDR, Signal

Doubles = npt.NDArray[np.float64]
_Table = TypeVar("_Table", bound=npt.NDArray[Any])

_LOG2_E, _LN2_HIGH, _LN2_LOW = 1.4426950408889634, 6.93147180369123816490e-01, 1.90821492927058770002e-10
_EXP_DEGREE, _LOG_TERMS = 14, 12
_WHITE_NITS, _WHITE_HLG = 203.0, 0.75


class Intensity(NamedTuple):
    """What determines the log intensity of a grey level.

    Attributes:
        gamma: exponent of the reverse gamma correction.
        log_eps: epsilon inside the logarithm, > 0.
        signal: what the levels mean.
    """

    gamma: float
    log_eps: float
    signal: Signal = SDR


@functools.lru_cache(maxsize=64)
def log_table(gamma: float, log_eps: float, signal: Signal = SDR) -> npt.NDArray[np.float32]:
    """Return L of every grey level; arguments as of :class:`Intensity`.

    Returns:
        [2**bits] float32, read-only, log-intensity units, never falling.
    """
    return _read_only(log_table_float64(gamma, log_eps, signal).astype(np.float32))


@functools.lru_cache(maxsize=64)
def log_table_float64(gamma: float, log_eps: float, signal: Signal = SDR) -> Doubles:
    """Return L of every grey level, [2**bits] float64, read-only.

    That of 8-bit SDR is computed in decimal arithmetic of 50 digits and then rounded once, because the logarithm of a
    maths library may differ in its last bit from host to host.
    """
    if signal != SDR:
        return _read_only(logarithm(log_eps + light_table(gamma, signal)))
    with decimal.localcontext(decimal.Context(prec=50)):
        exponent, floor = decimal.Decimal(gamma), decimal.Decimal(log_eps)
        levels = [(floor + (decimal.Decimal(level) / 255) ** exponent if level else floor).ln() for level in range(256)]
    return _read_only(np.array([float(level) for level in levels]))


def fine_table(table: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return L of the levels between frames: of grey levels in 1/FINE_STEPS, linear between grey levels.

    Args:
        table: [256] float32 or float64, L of grey levels; one of another length, of more than 8 bits or empty (no grey
            levels), is returned as it is.

    Returns:
        [255 FINE_STEPS + 1], of the same type.
    """
    if len(table) != 256:
        return table
    grey, part = np.divmod(np.arange(255 * FINE_STEPS + 1), FINE_STEPS)
    rise = np.append(np.diff(table), table.dtype.type(0))
    fine: npt.NDArray[Any] = table[grey] + rise[grey] * (part.astype(table.dtype) / table.dtype.type(FINE_STEPS))
    return fine


def linear_light(gamma: float, log_eps: float, signal: Signal = SDR) -> Doubles:
    """Return i of every grey level, [2**bits] float64 from 0 (black) to 1 (white); what is brighter counts as white."""
    return np.clip(exponential(log_table_float64(gamma, log_eps, signal)) - log_eps, 0.0, 1.0)


@functools.lru_cache(maxsize=16)
def light_table(gamma: float, signal: Signal) -> Doubles:
    """Return i of every grey level, [2**bits] float64, read-only, never falling."""
    value = np.arange(signal.white + 1) / signal.white
    return _read_only(_LIGHT[signal.transfer](value) if signal.transfer else _power(value, gamma))


@functools.lru_cache(maxsize=16)
def tone_table(gamma: float, signal: Signal) -> npt.NDArray[np.uint8]:
    """Return the grey level in ``frames`` of every grey level, [2**bits] uint8, read-only."""
    value = np.arange(signal.white + 1) / signal.white
    if signal.transfer:
        value = _power(np.minimum(light_table(gamma, signal), 1.0), 1.0 / gamma)
    return _read_only(np.floor(255.0 * value + 0.5).astype(np.uint8))


def tones_of(light: Doubles, gamma: float) -> npt.NDArray[np.uint8]:
    """Return the grey levels in ``frames`` of light, [...], 1 for white, as :func:`tone_table` rounds them."""
    return np.searchsorted(_tone_edges(gamma), light, side="right").astype(np.uint8)


@functools.lru_cache(maxsize=16)
def _tone_edges(gamma: float) -> Doubles:
    """Return the light at which each grey level but the first begins, [255], read-only."""
    return _read_only(_power((np.arange(255) + 0.5) / 255, gamma))


def eight_bits(frames: npt.NDArray[Any], signal: Signal) -> npt.NDArray[np.uint8]:
    """Return levels, [n, H, W], in 8 bits: rounded, with the same transfer. Levels of 8 bits are returned unchanged."""
    return frames if signal.bits == 8 else tone_table(1.0, Signal(signal.bits))[frames]


def _read_only(table: _Table) -> _Table:
    table.setflags(write=False)
    return table


def _pq(value: Doubles) -> Doubles:
    root = _power(value, 32 / 2523)
    ratio = np.maximum(root - 107 / 128, 0.0) / (2413 / 128 - 2392 / 128 * root)
    return 1e4 / _WHITE_NITS * _power(ratio, 16384 / 2610)


def _hlg(value: Doubles) -> Doubles:
    a = 0.17883277
    c = 0.5 - a * logarithm(np.array([4 * a]))[0]
    value = np.append(value, _WHITE_HLG)
    light: Doubles = np.where(value <= 0.5, value * value / 3, (exponential((value - c) / a) + (1 - 4 * a)) / 12)
    relative: Doubles = light[:-1] / light[-1]
    return relative


def _log(decades: float) -> Callable[[Doubles], Doubles]:
    return lambda value: exponential(decades * logarithm(np.array([10.0])) * (value - 1.0))


_LIGHT: dict[str, Callable[[Doubles], Doubles]] = {
    "pq": _pq,
    "hlg": _hlg,
    "log100": _log(2.0),
    "log316": _log(2.5),
    "linear": lambda value: value,
}
"""i(V) by the names of ``picture.TRANSFERS``."""


def _power(base: Doubles, exponent: float) -> Doubles:
    """Return base ** exponent for base >= 0 and exponent > 0."""
    is_zero = base == 0.0
    return np.where(is_zero, 0.0, exponential(exponent * logarithm(np.where(is_zero, 1.0, base))))


def logarithm(x: Doubles) -> Doubles:
    """Return ln x of positive numbers, [...], to a few units in the last place.

    x = 2 ** n m, sqrt(1/2) <= m < sqrt(2), and ln m = 2 artanh((m - 1) / (m + 1)), its series truncated below 1e-18.
    """
    fraction, whole = np.frexp(x)
    is_low = fraction < 0.7071067811865476
    fraction, whole = np.where(is_low, 2.0 * fraction, fraction), np.where(is_low, whole - 1, whole)
    s = (fraction - 1.0) / (fraction + 1.0)
    square, sum_ = s * s, np.zeros_like(s)
    for k in range(_LOG_TERMS, 0, -1):
        sum_ = (sum_ + 1.0 / (2 * k + 1)) * square
    rest = 2.0 * s + 2.0 * s * sum_
    return whole * _LN2_HIGH + (rest + whole * _LN2_LOW)


def exponential(x: Doubles) -> Doubles:
    """Return e ** x, [...], to a few units in the last place.

    x = n ln 2 + r, |r| <= ln 2 / 2, and the Taylor series of e ** r (degree 14, truncated below 1e-18).
    """
    x = np.maximum(x, -700.0)
    whole = np.floor(x * _LOG2_E + 0.5)
    rest = (x - whole * _LN2_HIGH) - whole * _LN2_LOW
    sum_ = np.ones_like(rest)
    for k in range(_EXP_DEGREE, 0, -1):
        sum_ = 1.0 + sum_ * rest / k
    return np.ldexp(sum_, whole.astype(np.int64))
