"""The keyed permutation: a bijection, keyed by seed and epoch, without a pattern, the same for ever."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from v2v_server.schedule import Permutation, hashed_below

seeds = st.integers(0, 2**64 - 1)
epochs = st.integers(0, 2**32 - 1)


def order(n: int, seed: int, epoch: int) -> list[int]:
    permutation = Permutation(n, seed, epoch)
    return [permutation(index) for index in range(n)]


def chi_square(counts: np.ndarray) -> float:
    """How many standard deviations the chi-square statistic of equal expectations lies above its mean."""
    expected = counts.sum() / counts.size
    freedom = counts.size - 1
    return float((((counts - expected) ** 2 / expected).sum() - freedom) / np.sqrt(2 * freedom))


@given(st.integers(1, 500) | st.sampled_from((255, 256, 257, 1023, 1024, 1025, 4096, 4097)), seeds, epochs)
@settings(max_examples=60)
def test_bijection(n: int, seed: int, epoch: int) -> None:
    assert sorted(order(n, seed, epoch)) == list(range(n))


@given(st.integers(2001, 2**48), seeds, epochs, st.data())
@settings(max_examples=60)
def test_large_domains_stay_inside_and_do_not_collide(n: int, seed: int, epoch: int, data: st.DataObject) -> None:
    indices = data.draw(st.sets(st.integers(0, n - 1) | st.sampled_from((0, 1, n - 2, n - 1)), max_size=50))
    permutation = Permutation(n, seed, epoch)
    images = {permutation(index) for index in indices}
    assert len(images) == len(indices)
    assert all(0 <= image < n for image in images)


def test_golden_order() -> None:
    """Saved positions rest on this order: a change of it raises NUMERICS_VERSION."""
    assert order(12, 0, 0) == [1, 4, 0, 10, 11, 6, 5, 2, 8, 3, 9, 7]
    assert order(12, 0, 1) == [0, 2, 4, 7, 6, 8, 3, 11, 5, 1, 9, 10]
    large = Permutation(22_725, 2**64 - 1, 7)
    assert [large(index) for index in (0, 1, 2, 11_362, 22_724)] == [14455, 10594, 7251, 19413, 15827]
    assert Permutation(2**48, 1, 2**32 - 1)(2**48 - 1) == 66_743_391_587_805
    assert [hashed_below(22_725, 5, 3, 1000, candidate) for candidate in (1, 2, 7)] == [10875, 1115, 14931]


@pytest.mark.parametrize("index", [-1, 10, 2**64])
def test_an_index_outside_is_refused(index: int) -> None:
    with pytest.raises(IndexError, match="of an epoch of 10 sequences"):
        Permutation(10, 0, 0)(index)


def test_an_empty_domain_is_refused() -> None:
    with pytest.raises(ValueError, match="0 elements"):
        Permutation(0, 0, 0)


@pytest.mark.parametrize("n", [7, 40])
@pytest.mark.parametrize("index", [0, 1, 6])
def test_every_place_is_equally_likely(n: int, index: int) -> None:
    draws = 60 * n
    by_seed = np.bincount([Permutation(n, seed, 0)(index) for seed in range(draws)], minlength=n)
    by_epoch = np.bincount([Permutation(n, 9, epoch)(index) for epoch in range(draws)], minlength=n)
    assert abs(chi_square(by_seed)) < 5
    assert abs(chi_square(by_epoch)) < 5


# --- substitutes ------------------------------------------------------------------------------------------------------


@given(st.integers(1, 2**48), st.lists(seeds, min_size=1, max_size=5))
def test_hashed_below_stays_below(n: int, words: list[int]) -> None:
    assert 0 <= hashed_below(n, *words) < n
    assert hashed_below(n, *words) == hashed_below(n, *words)


def test_words_beyond_64_bits_are_refused() -> None:
    with pytest.raises(OverflowError):
        hashed_below(10, 2**64)
