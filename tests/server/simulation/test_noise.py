"""The noise is standard normal, and nothing in it knows of anything else."""

from __future__ import annotations

import ast
import inspect
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.oracles.noise import shot_words, standard_normals, start_uniforms, words
from v2v_server.simulation import noise, pixel
from v2v_server.simulation.effects import EFFECTS, dead_pixels
from v2v_server.simulation.pixel import hot_pixels

KEY = (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344)


Reals = np.ndarray[Any, np.dtype[np.float64]]


@pytest.fixture(scope="module")
def normals() -> Reals:
    """[200, 51200]: 10.24 million draws."""
    return standard_normals(KEY, 200, 51_200).astype(np.float64)


@pytest.fixture(scope="module")
def squares(normals: Reals) -> Reals:
    """Return their squares, standardised but for a factor of 2."""
    return normals**2 - 1


def test_mean_variance_and_shape(normals: Reals, squares: Reals) -> None:
    z, n = normals, normals.size
    assert abs(z.mean()) < 4 / math.sqrt(n)
    assert abs(z.var() - 1) < 4 * math.sqrt(2 / n)
    assert abs(((squares + 1) * z).mean()) < 4 * math.sqrt(15 / n)
    assert abs(((squares + 1) ** 2).mean() - 3) < 4 * math.sqrt(96 / n)


@pytest.mark.parametrize("sigmas", [0.5, 1.0, 2.0, 3.0, 4.0, 4.5])
def test_tails(normals: Reals, sigmas: Any) -> None:
    expected = math.erfc(sigmas / math.sqrt(2)) * normals.size
    assert abs(np.count_nonzero(np.abs(normals) > sigmas) - expected) < 4 * math.sqrt(expected)


def test_the_largest_radius_is_that_of_the_smallest_word() -> None:
    cosine, sine = noise.box_muller(np.array([0, 1, 2**31 - 1], np.uint32), np.zeros(3, np.uint32))
    np.testing.assert_allclose(cosine[:2], math.sqrt(62 * math.log(2)), rtol=1e-5)
    assert 0 <= cosine[2] < 1e-4
    np.testing.assert_allclose(sine, 0, atol=1e-6)


def test_box_muller_agrees_with_the_textbook() -> None:
    words = np.random.default_rng(0).integers(0, 2**32, (2, 100_000), dtype=np.uint32)
    cosine, sine = noise.box_muller(words[0], words[1])
    radius = np.sqrt(-2 * np.log(((words[0] & 0x7FFFFFFF) | 1) / 2.0**31))
    angle = 2 * np.pi * words[1].view(np.int32) / 2.0**32
    np.testing.assert_allclose(cosine, radius * np.cos(angle), atol=1e-4)
    np.testing.assert_allclose(sine, radius * np.sin(angle), atol=1e-4)


def correlation(a: Reals, b: Reals) -> float:
    """In units of its sampling error."""
    return float(np.einsum("ij,ij->", a, b)) / math.sqrt(a.size)


@pytest.mark.parametrize(
    ("steps", "pixels"),
    [*((0, pixels) for pixels in (1, 2, 64, 128, 512, 1024)), *((n, 0) for n in (1, 2, 3, 4, 8, 64))],
)
def test_neighbouring_steps_and_pixels_are_independent(normals: Reals, squares: Reals, steps: int, pixels: int) -> None:
    one, other = np.s_[: 200 - steps, : 51_200 - pixels], np.s_[steps:, pixels:]
    assert abs(correlation(normals[one], normals[other])) < 4.5
    assert abs(correlation(squares[one], squares[other])) / 2 < 4.5


@pytest.mark.parametrize("word", range(4))
@pytest.mark.parametrize("bit", [0, 1, 16, 31])
def test_keys_that_differ_in_one_bit_are_independent(normals: Reals, squares: Reals, word: Any, bit: Any) -> None:
    other = list(KEY)
    other[word] ^= 1 << bit
    near = standard_normals((other[0], other[1], other[2], other[3]), 40, 25_000).astype(np.float64)
    ours = normals[:40, :25_000]
    assert abs(correlation(ours, near)) < 4.5
    assert abs(correlation(squares[:40, :25_000], near**2 - 1)) / 2 < 4.5
    assert abs(correlation(ours[:, 1:], near[:, :-1])) < 4.5
    assert abs(correlation(ours[2:], near[:-2])) < 4.5


def test_four_corners_of_pixel_and_pair_are_independent(normals: Reals, squares: Reals) -> None:
    # The words of pixel and pair meet by exclusive or: corners of a rectangle xor to zero before they are mixed.
    for values in (normals, squares):
        corner = values[0:98:2, :25_000] * values[100:198:2, :25_000]
        product = corner * (values[0:98:2, 25_000:50_000] * values[100:198:2, 25_000:50_000])
        assert abs(product.mean()) < 5 * product.std() / math.sqrt(product.size)


def test_words_of_one_purpose_are_distinct_and_purposes_differ() -> None:
    place = np.arange(200_000)
    assert len(np.unique(words(KEY, noise.START, place))) == len(place)
    agreeing = words(KEY, noise.PIXEL_RADIUS, place) == words(KEY, noise.PIXEL_ANGLE, place)
    assert np.count_nonzero(agreeing) <= 2


@given(st.tuples(*[st.integers(0, 2**32 - 1)] * 4), st.integers(0, 20), st.integers(1, 50), st.floats(0, 1))
def test_the_compiled_words_are_those_of_the_definition(
    key: noise.NoiseKey, purpose: int, count: int, share: float
) -> None:
    counters, hot = np.arange(count) * 85_899_345, round(share * count)
    np.testing.assert_array_equal(pixel.words(key, purpose, counters), words(key, purpose, counters))
    position, normal = hot_pixels(key, hot, count)
    np.testing.assert_array_equal(position, np.sort(np.argsort(words(key, noise.HOT_PLACE, np.arange(count)))[:hot]))
    radius, angle = (words(key, each, position) for each in (noise.HOT_RADIUS, noise.HOT_ANGLE))
    np.testing.assert_array_equal(normal, noise.box_muller(radius, angle)[0])


def test_start_uniforms_are_uniform() -> None:
    u = start_uniforms(KEY, 200_000)
    assert u.min() >= 0
    assert u.max() < 1
    counts = np.histogram(u, 50, (0, 1))[0]
    assert ((counts - 4000) ** 2 / 4000).sum() < 49 + 5 * math.sqrt(98)


def test_dead_and_hot_pixels_are_chosen_apart() -> None:
    key = (1, 2, 3, 4)
    dead = dead_pixels.positions(key, 0.5, 1000)
    assert len(set(dead.tolist())) == 500
    assert (np.diff(dead) > 0).all()
    assert dead_pixels.positions(key, 0.0, 1000).size == 0
    hot, _ = hot_pixels(key, 500, 1000)
    # Hypergeometric: 250 in common on average, with a deviation of 7.9.
    assert abs(len(set(dead.tolist()) & set(hot.tolist())) - 250) < 4 * 7.9


def test_shot_words_are_uniform_and_independent() -> None:
    """Of pixel, step and sign; the smallest ones too, which alone make events."""
    steps, pixels = 200, 2000
    both = np.stack(shot_words((9, 8, 7, 6), steps, pixels)) * 2.0**-32
    n = both[0].size
    for uniform in both:
        assert abs(uniform.mean() - 0.5) < 4 / math.sqrt(12 * n)
        for chance in (0.5, 0.1, 0.01):
            rare = uniform < chance
            assert abs(rare.mean() - chance) < 4 * math.sqrt(chance / n)
            for one, other in ((rare[1:], rare[:-1]), (rare[2:], rare[:-2]), (rare[:, 1:], rare[:, :-1])):
                assert abs((one & other).mean() - chance**2) < 4.5 * chance / math.sqrt(n)
    assert abs(((both[0] < 0.1) & (both[1] < 0.1)).mean() - 0.01) < 4 * 0.1 / math.sqrt(n)


def test_no_two_effects_share_a_purpose() -> None:
    """Or their noise would be the same. An effect states each purpose that it draws words of."""
    taken = [*range(noise.HOT_ANGLE + 1), *(each for effect in EFFECTS for each in getattr(effect, "PURPOSES", ()))]
    assert len(set(taken)) == len(taken)
    for effect in EFFECTS:
        for node in ast.walk(ast.parse(inspect.getsource(effect))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) in ("folds_of", "smallest_words", "words"):
                assert getattr(effect, ast.unparse(node.args[1])) in effect.PURPOSES, effect.FIELD
