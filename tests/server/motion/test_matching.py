"""Motion between two pictures."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.oracles.rendered import rendered_scene
from v2v_server.motion.matching import UNITS_PER_PX, Vectors, motion
from v2v_server.motion.pyramid import Pyramid

HALF_PX = UNITS_PER_PX // 2


def without_slow(vectors: Vectors, shortest: int) -> Vectors:
    """Return vectors [2, rows, columns] with those below a length, 1/UNITS_PER_PX px, set to zero."""
    return vectors * (np.square(vectors, dtype=np.int64).sum(axis=0) >= shortest * shortest)


@pytest.mark.parametrize("px", [1.3, 4.0, 12.0])
def test_a_pan_is_found(px: float) -> None:
    first, second = rendered_scene("gravel", 128, 128, 30 * px).frames(30, 2)
    found = without_slow(motion(Pyramid.of(first), Pyramid.of(second)), HALF_PX)[:, 6:-6, 6:-6] / UNITS_PER_PX
    lengths = np.hypot(*found)
    assert abs(np.median(lengths) - px) < 0.25
    assert np.quantile(np.hypot(*(found - np.median(found, axis=(1, 2), keepdims=True))), 0.9) < 0.5


def test_what_rests_has_no_motion() -> None:
    """Neither in a still picture, nor under a lamp that flickers, nor where an edge moves by a third of a pixel."""
    still = rendered_scene("coffee", 128, 128, 0.0).frames(30, 2)
    assert not without_slow(motion(Pyramid.of(still[0]), Pyramid.of(still[1])), HALF_PX).any()
    noisy = still[1] + np.random.default_rng(0).integers(-1, 2, still[1].shape).astype(np.uint8)
    assert not without_slow(
        motion(Pyramid.of(still[0]), Pyramid.of(np.where(still[1] % 255, noisy, still[1]))), HALF_PX
    ).any()
    lit = rendered_scene("flicker", 128, 128, 0.0).frames(30, 2)
    assert (without_slow(motion(Pyramid.of(lit[0]), Pyramid.of(lit[1])), HALF_PX) == 0).all(axis=0).mean() > 0.99
    slow = rendered_scene("coffee", 128, 128, 9.0).frames(30, 2)
    assert (without_slow(motion(Pyramid.of(slow[0]), Pyramid.of(slow[1])), HALF_PX) == 0).all(axis=0).mean() > 0.98


@settings(deadline=None, max_examples=40)
@given(
    st.integers(4, 70), st.integers(4, 70), st.sampled_from(("noise", "black", "checked", "bright", "cut")),
    st.integers(0, 2**32 - 1),
)  # fmt: skip
def test_any_pictures_have_bounded_motion(height: int, width: int, kind: str, seed: int) -> None:
    generator = np.random.default_rng(seed)
    first = generator.integers(0, 256, (height, width)).astype(np.uint8)
    second = {
        "noise": generator.integers(0, 256, (height, width)).astype(np.uint8),
        "black": np.zeros_like(first),
        "checked": (np.indices(first.shape).sum(axis=0) % 2 * 255).astype(np.uint8),
        "bright": np.full_like(first, 255),
        "cut": np.roll(first, 40, 1),
    }[kind]
    for one, other in ((first, second), (second, first)):
        found = without_slow(motion(Pyramid.of(one), Pyramid.of(other)), HALF_PX)
        assert found.shape == (2, -(-height // 4), -(-width // 4))
        assert np.abs(found.astype(int)).max() <= 2 * (max(height, width) + 32) * UNITS_PER_PX
        squares = (found.astype(int) ** 2).sum(axis=0)
        assert squares[squares > 0].min(initial=HALF_PX**2) >= HALF_PX**2
