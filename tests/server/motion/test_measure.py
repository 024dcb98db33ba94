"""What moves, measured on scenes whose motion is known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

from tests.oracles.rendered import photo
from v2v_server.motion.measure import MeasuredMotion, measure, together

SIDE_PX, FRAMES = 128, 7
Y, X = np.mgrid[0:SIDE_PX, 0:SIDE_PX] - SIDE_PX / 2
Frames = npt.NDArray[np.uint8]


def film(light: Callable[[int], npt.NDArray[np.float64]]) -> Frames:
    return np.stack([np.rint(255.0 * np.clip(light(at), 0.0, 1.0)) for at in range(FRAMES)]).astype(np.uint8)


def pan(px: float, picture: str = "coffee") -> Frames:
    return film(lambda at: photo(picture, Y, X - px * at))


def discs(places: Callable[[int], npt.NDArray[np.float64]], radius: float, picture: str) -> Frames:
    """Render plain discs at places [n, (y, x)] over a still picture."""

    def light(at: int) -> npt.NDArray[np.float64]:
        away = np.min([np.hypot(Y - y, X - x) for y, x in places(at)], axis=0)
        cover = np.clip(0.5 + radius - away, 0.0, 1.0)
        return photo(picture, Y, X) * (1.0 - cover) + 0.95 * cover

    return film(light)


def insects() -> Frames:
    rng = np.random.default_rng(0)
    starts, headings = rng.uniform(-60, 60, (30, 2)), rng.uniform(0.0, 2.0 * np.pi, 30)
    flights = 12.0 * np.stack([np.sin(headings), np.cos(headings)], axis=1)
    return discs(lambda at: (starts + at * flights + 64) % SIDE_PX - 64, 1.5, "coffee")


def rain() -> Frames:
    rng = np.random.default_rng(0)
    tops, columns = rng.uniform(-64, 64, 60), rng.integers(0, SIDE_PX, 60)

    def light(at: int) -> npt.NDArray[np.float64]:
        seen = photo("coffee", Y, X)
        for top, column in zip(tops, columns, strict=True):
            below = (Y[:, column] - top - 30 * at + 64) % SIDE_PX
            seen[:, column] += 0.25 * (below < 20)
        return seen

    return film(light)


def share(part: int, found: MeasuredMotion) -> float:
    return part / found.changed


@pytest.mark.parametrize("px", [1.0, 3.0, 12.0])
def test_a_pan_moves_by_its_pixels_and_is_followed(px: float) -> None:
    found = measure(pan(px))
    assert found.px_per_frame(0.5) == px
    assert found.px_per_frame(0.9) == pytest.approx(px, abs=0.75)
    assert 50 * found.turned < found.paired
    assert share(found.lost, found) < 0.05
    assert share(found.uncovered, found) < 0.02


@pytest.mark.parametrize("px", [4, 8])
def test_half_of_what_a_plain_disc_changes_is_background_that_is_seen_once(px: int) -> None:
    """The disc covers half of both crescents halfway. Grain that fits both frames by chance is counted as followed."""
    found = measure(discs(lambda at: np.array([[0.0, px * (at - 3)]]), 32.0, "gravel"))
    assert 0.3 < share(found.uncovered, found) < 0.52
    assert share(found.lost, found) < 0.1
    assert found.px_per_frame(0.5) == pytest.approx(px, abs=1.0)


@pytest.mark.parametrize("scene", [insects, rain])
def test_no_block_follows_what_is_small_and_fast(scene: Callable[[], Frames]) -> None:
    found = measure(scene())
    assert share(found.lost, found) > 0.5


def test_no_block_follows_a_lamp_that_flickers() -> None:
    found = measure(film(lambda at: photo("coffee", Y, X) * (1.0 - 0.3 * (at % 2))))
    assert share(found.lost, found) > 0.5


def test_a_shake_turns_back_in_every_step_a_pan_in_none_and_repeats_change_nothing() -> None:
    shaken = pan(6.0)[[0, 1, 0, 1, 0]]
    found, repeated = measure(shaken), measure(shaken[[0, 1, 1, 2, 3, 3, 4]])
    assert found.turned > 0.98 * found.paired > 0
    assert repeated == found


@pytest.mark.parametrize("count", [1, 2, 5])
def test_nothing_moves_in_a_still_clip(count: int) -> None:
    found = measure(np.repeat(pan(0.0)[:1], count, axis=0))
    assert found == MeasuredMotion()
    assert found.px_per_frame(0.5) == 0.0


def test_of_a_long_clip_the_middle_is_measured() -> None:
    moving = pan(3.0)
    still = np.repeat(moving[:1], 20, axis=0)
    assert measure(np.concatenate([still, moving, moving[-1:].repeat(20, axis=0)])) == measure(moving)


def test_clips_add_up() -> None:
    slow, fast = measure(pan(1.0)), measure(pan(6.0))
    both = together([slow, fast])
    assert both.changed == slow.changed + fast.changed
    assert both.px_per_frame(0.0) <= slow.px_per_frame(0.5) < both.px_per_frame(0.9) <= fast.px_per_frame(0.95)
    assert together([]) == MeasuredMotion()
