"""The random numbers of a virtual camera's pixels: THE definition.

``pixel.py`` computes them inside its loops; the tests hold it equal, bit for bit, to a definition in numpy
(``tests/oracles/noise.py``). Every number is a pure function of (noise_key, purpose, counter), so it does not depend on
the order of the loops, on the size of a block, or on any other pixel. All arithmetic is unsigned 32-bit integer (modulo
2**32) or IEEE binary32 with one rounding per operation, in the order written, and no function of a maths library but
the square root, which IEEE 754 rounds correctly: the same bits on every host.

Words. ``scramble`` is a bijection of 32-bit words whose every output bit depends on every input bit ("triple32" of
C. Wellons' hash prospector, public domain); the words k0..k3 are the noise key:

    word(purpose, n) = S(S(n + fold(2 purpose)) + fold(2 purpose + 1)),    S = scramble
    fold(c)          = S(S(S(S(S(c * 0x9E3779B9) + k0) + k1) + k2) + k3)

For one key and purpose this is a bijection of n: no two pixels share a word.

Two normals per pixel and pair of steps. For pixel p and steps 2m and 2m+1, * modulo 2**32, ^ exclusive or:

    z = word(PIXEL_RADIUS, p) ^ word(PAIR_RADIUS, m)
    x = M(z),    M = two rounds of z ^ z >> 16, z * 0x21F0AAAD and z ^ z >> 15, z * 0x735A2D97
    y = (x ^ x >> 15 ^ word(PIXEL_ANGLE, p) ^ word(PAIR_ANGLE, m)) * 0xAC4C1B51

(the multipliers are those of "lowbias32" and "triple32"). For a given x, y is a bijection of its own two words, so the
pair is uniform over 64 bits; x keeps the y of neighbours apart. Then the transform of Box and Muller (1958):

    u = (x mod 2**31, made odd) / 2**31 in (0, 1),    r = sqrt(-2 ln u),    t = signed(y) / 2**32 in [-1/2, 1/2)
    normal(2m) = r cos(2 pi t),    normal(2m+1) = r sin(2 pi t)

The smallest u is 2**-31: |normal| reaches 6.56. The logarithm splits u = 2**e (1 + f), 1 + f in [sqrt(1/2), sqrt(2)),
with ln(1+f) = f P(f), P of degree 4 (relative error 5e-5); sin(pi t) = t S(t^2) and cos(pi t) = C(t^2), both of
degree 3 (errors 6e-7, 7e-6), give cos(2 pi t) = 1 - 2 sin^2(pi t) and sin(2 pi t) = 2 sin(pi t) cos(pi t). The
coefficients are minimax fits by the algorithm of Remez, rounded to binary32. Noise needs no higher degree: the
variance is off by less than 5e-5, which 10^8 draws would not show.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Words = npt.NDArray[np.uint32]
Reals = npt.NDArray[np.float32]
NoiseKey = tuple[int, int, int, int]

TIME, PIXEL_RADIUS, PIXEL_ANGLE, PAIR_RADIUS, PAIR_ANGLE, START, HOT_PLACE, HOT_RADIUS, HOT_ANGLE = range(9)
"""Purposes of words. Numbers are never reused; the others belong to effects, which state theirs (``PURPOSES``)."""

GOLDEN = np.uint32(0x9E3779B9)
SCRAMBLE_FACTORS = (np.uint32(0xED5AD4BB), np.uint32(0xAC4C1B51), np.uint32(0x31848BAB))
MIX_FACTORS = (np.uint32(0x21F0AAAD), np.uint32(0x735A2D97), np.uint32(0xAC4C1B51))

SQRT_HALF_BITS = np.int32(0x3F3504F3)
MINUS_2_LN_2 = np.float32(-1.3862943611198906)
LOG_COEFFICIENTS = tuple(
    # -2 P(f), constant term first: the factor -2 of the radius costs no operation here.
    np.float32(-2.0 * c)
    for c in (
        0.999966181412439935, -0.499450648946033938, 0.336388843563420227,
        -0.270945983352242806, 0.176580523334284036,
    )
)  # fmt: skip
SIN_COEFFICIENTS = tuple(
    np.float32(c) for c in (3.141582022152207, -5.167142796404795, 2.5418990277836127, -0.5546361973896712)
)
COS_COEFFICIENTS = tuple(
    np.float32(c) for c in (0.99999329528942, -4.933938015595793, 4.041283830071049, -1.222127070751509)
)


def box_muller(x: Words, y: Words) -> tuple[Reals, Reals]:
    """Return two independent standard normals of each pair of words, [...]: (r cos, r sin), float32."""
    value = ((x & np.uint32(0x7FFFFFFF)) | np.uint32(1)).astype(np.int32).astype(np.float32)
    bits = value.view(np.int32)
    exponent = (bits - SQRT_HALF_BITS) >> np.int32(23)
    fraction = (bits - (exponent << np.int32(23))).view(np.float32) - np.float32(1)
    l0, l1, l2, l3, l4 = LOG_COEFFICIENTS
    square = fraction * fraction
    high = (l2 + l3 * fraction) + l4 * square
    log = (exponent - np.int32(31)).astype(np.float32) * MINUS_2_LN_2
    radius = np.sqrt(log + fraction * ((l0 + l1 * fraction) + high * square))

    turn = y.view(np.int32).astype(np.float32) * np.float32(2.0**-32)
    square = turn * turn
    sine = turn * _cubic(SIN_COEFFICIENTS, square)
    twice = sine + sine
    return radius * (np.float32(1) - twice * sine), radius * (twice * _cubic(COS_COEFFICIENTS, square))


def _cubic(coefficients: tuple[np.float32, ...], x: Reals) -> Reals:
    # Estrin's scheme, as for the logarithm above: a shorter chain of dependent operations than Horner's.
    c0, c1, c2, c3 = coefficients
    return (c0 + c1 * x) + (c2 + c3 * x) * (x * x)
