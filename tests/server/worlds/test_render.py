"""Pictures and truth of drawn worlds, against the oracle written from the definition."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.oracles.known_motion import photograph
from tests.oracles.worlds import Oracle, event_errors, waves
from tests.server.simulation.generic_processor import COMPILE_SECONDS, printed_on_a_generic_processor
from v2v_protocol.recipe import PRESETS, Recipe
from v2v_protocol.spec import StreamSpec
from v2v_server.simulation.draw import draw
from v2v_server.worlds.render import (
    PhotoPyramid,
    flow_of,
    levels_between,
    masks_of,
    parts_by_change,
    parts_by_motion,
    pyramid_of,
    render,
    tracks_of,
)
from v2v_server.worlds.world import World, draw_world

RECIPE = PRESETS["worlds"].replace(crop_height_px=48, crop_width_px=64, world_patch_px=[12.0, 60.0], track_points=40)
FAST = {"world_speed_px": [200.0, 2000.0], "world_turn_deg": [90.0, 360.0], "world_zoom": [0.5, 1.0]}
SCALED = {"resize_scale": [0.4, 0.9], "flip_probability": 1.0}
SECONDS = (0.0, 2.0)


@cache
def photo() -> npt.NDArray[np.uint8]:
    """Return a photograph with odd sides."""
    return np.ascontiguousarray(photograph("astronaut")[60:421, 40:457])


@cache
def pyramid() -> PhotoPyramid:
    """Return its pyramid."""
    return pyramid_of(photo())


def world_of(recipe: Recipe, index: int, picture: npt.NDArray[Any] | None = None) -> World:
    """Draw the world of a sample."""
    height, width = (photo() if picture is None else picture).shape
    params = draw(
        recipe, seed=5, epoch=1, index=index, picture_height_px=height, picture_width_px=width, video_id="photo.png"
    )
    return draw_world(
        recipe, params, seed=5, epoch=1, index=index, picture_px=(height, width), seconds=SECONDS
    )  # fmt: skip


def mirrored(world: World, pictures: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return pictures as the view shows them."""
    return pictures[..., ::-1] if world.flip else pictures


@pytest.mark.parametrize("more", [{}, FAST, SCALED, FAST | SCALED, {"world_plain_share": 1.0}])
def test_pictures_are_those_of_the_definition(more: dict[str, Any]) -> None:
    """Within one level of twelve bits, which leaves the bar of one of eight bits far behind."""
    patches, times = 0, np.array([0.0, 0.013, 1.0, 1.7, 2.0])
    for index in range(8):
        world = world_of(RECIPE.replace(**more), index)
        oracle, made = Oracle(world, photo()), mirrored(world, render(pyramid(), world, times))
        patches += len(world.layers) - 1
        for seconds, picture in zip(times, made, strict=True):
            assert np.abs(picture - oracle.picture(float(seconds))).max() <= 1.0
    assert patches > 4


@pytest.mark.parametrize("more", [{}, FAST, SCALED, FAST | SCALED])
def test_flow_masks_and_validity_are_those_of_the_definition(more: dict[str, Any]) -> None:
    hidden = left = 0
    for index, apart in enumerate([1 / 240, 1 / 25, 0.3, -1 / 12] * 4):
        world = world_of(RECIPE.replace(**more), index)
        oracle, at, other = Oracle(world, photo()), 0.4 + 0.075 * index, 0.4 + 0.075 * index + apart
        grid = oracle.grid()
        there, seen, layer = oracle.followed(at, other, grid)
        flow, valid = flow_of(world, at, other)
        on_outline = oracle.at_outline(at, grid) | oracle.at_outline(other, np.where(np.isfinite(there), there, 0.0))
        expected = (there - grid) * np.array([-1.0 if world.flip else 1.0, 1.0])[:, None, None]
        near = (oracle.at_outline(at, grid) == 0) & seen
        assert np.abs(flow - expected)[:, near].max(initial=0.0) < 0.01
        top, crop_left, height, width = world.crop
        edge = np.minimum(np.abs(there[0] - crop_left), np.abs(there[0] - crop_left - width)) < 1e-6
        edge |= np.minimum(np.abs(there[1] - top), np.abs(there[1] - top - height)) < 1e-6
        assert (valid[0] == seen)[~on_outline & ~edge].all()
        assert (masks_of(world, at)[0] == layer)[~oracle.at_outline(at, grid)].all()
        inside = np.isfinite(there[0]) & (there[0] >= crop_left) & (there[0] < crop_left + width)
        hidden += int(np.count_nonzero(inside & ~seen))
        left += int(np.count_nonzero(~inside))
    assert left > 0
    assert hidden > 0 or not more


@pytest.mark.parametrize("more", [{}, FAST | SCALED])
def test_tracks_follow_their_points(more: dict[str, Any]) -> None:
    """Each point is in front at a moment of its own, and is where the definition says at all others."""
    times = np.linspace(*SECONDS, 9)
    for index in range(8):
        world = world_of(RECIPE.replace(**more), index)
        oracle, tracks = Oracle(world, photo()), tracks_of(world, times)
        top, left, height, width = world.crop
        start = world.points[:, 2] * SECONDS[1]
        for point in range(0, 40, 3):
            x = world.points[point, :2].reshape(2, 1, 1) * np.array([width, height]).reshape(2, 1, 1)
            x = x + np.array([left, top]).reshape(2, 1, 1)
            if oracle.at_outline(float(start[point]), x).any():
                continue
            for moment, seconds in enumerate(times):
                there, seen, _ = oracle.followed(float(start[point]), float(seconds), x)
                if not oracle.at_outline(float(seconds), np.where(np.isfinite(there), there, 0.0)).any():
                    assert tracks[moment, point, 2] == seen
                if seen:
                    place = there[0, 0, 0] - left, there[1, 0, 0] - top
                    expected = (width - place[0] if world.flip else place[0]), place[1]
                    np.testing.assert_allclose(tracks[moment, point, :2], expected, atol=0.01)
        own = tracks_of(world, start)[np.arange(40), np.arange(40)]
        assert (own[:, 2] == 1).all()


def test_a_picture_that_stands_still_is_the_photograph_itself() -> None:
    recipe = Recipe(crop_height_px=48, crop_width_px=64, flip_probability=0.0)
    for index in range(4):
        world = world_of(recipe, index)
        top, left, height, width = world.crop
        part = photo()[top : top + height, left : left + width].astype(np.uint32)
        for picture in render(pyramid(), world, np.array([0.0, 1.3])):
            np.testing.assert_array_equal(picture, (part * 4095 * 2 + 255) // 510)
        flow, valid = flow_of(world, 0.0, 2.0)
        assert not flow.any()
        assert valid.all()


def test_shares_of_still_and_turning_worlds() -> None:
    still = RECIPE.replace(world_still_share=1.0, world_patches=0)
    turning = RECIPE.replace(world_still_share=0.0, world_turn_only_share=1.0, world_patches=0)
    for index in range(4):
        assert not flow_of(world_of(still, index), 0.0, 1.5)[0].any()
        world = world_of(turning, index)
        flow, _ = flow_of(world, 0.5, 0.6)
        assert flow.any()
        middle = flow[:, 23:25, 31:33].mean(axis=(1, 2))
        np.testing.assert_allclose(middle, 0.0, atol=0.02)


def test_no_draw_changes_another() -> None:
    """A field's range moves its own draw alone."""
    plain = world_of(RECIPE, 3)
    for name, value in (("world_zoom", 0.5), ("world_tilt", 0.0), ("world_shake_px", 9.0), ("world_patch_px", 20.0)):
        other = world_of(RECIPE.replace(**{name: value}), 3)
        assert len(other.layers) == len(plain.layers)
        np.testing.assert_array_equal(other.layers[0].speed_px, plain.layers[0].speed_px)
        np.testing.assert_array_equal(other.points, plain.points)
        np.testing.assert_array_equal(other.knots[2:], plain.knots[2:])
    alone = world_of(RECIPE.replace(world_patches=0), 3)
    np.testing.assert_array_equal(alone.places(np.array([0.3]))[:, 0], plain.places(np.array([0.3]))[:, 0])


@settings(max_examples=30, deadline=None)
@given(
    height=st.integers(1, 40), width=st.integers(1, 40), deep=st.booleans(), index=st.integers(0, 2**48 - 1),
    tilt=st.floats(0.0, 0.25), scale=st.floats(0.05, 30.0),
)  # fmt: skip
def test_any_photograph_and_any_draw_give_levels_and_numbers(
    height: int, width: int, deep: bool, index: int, tilt: float, scale: float
) -> None:
    """Sides down to one pixel, the most extreme motion."""
    random = np.random.default_rng(index)
    grey = random.integers(0, 65536 if deep else 256, (height, width), np.uint16 if deep else np.uint8)
    recipe = RECIPE.replace(
        crop_height_px=5, crop_width_px=3, resize_scale=[scale, 100.0], world_speed_px=1e4, world_turn_deg=3600.0,
        world_zoom=10.0, world_tilt=tilt, world_shake_px=1000.0, world_patch_px=[4.0, 16000.0],
    )  # fmt: skip
    world = world_of(recipe, index, grey)
    times = np.array([-1.0, 0.0, 0.7, 2.0, 5.0])
    pictures = render(pyramid_of(grey), world, times)
    low, high = int(grey.min()), int(grey.max())
    white = 65535 if deep else 255
    assert pictures.min() >= low * 4095 // white
    assert pictures.max() <= -(-high * 4095 // white)
    flow, valid = flow_of(world, 0.0, 1.0)
    assert np.isfinite(flow).all()
    assert set(np.unique(valid)) <= {0, 1}
    assert np.isfinite(tracks_of(world, times)).all()
    assert masks_of(world, 1.0).max() < len(world.layers)


def test_levels_between_are_pictures_at_their_times() -> None:
    """A step has more sub-steps if it moves farther, a paused one has none; they are mirrored with the crop."""
    recipe = RECIPE.replace(
        world_speed_px=240.0, world_still_share=0.0, world_turn_only_share=0.0, flip_probability=1.0
    )
    world, seconds = world_of(recipe, 1), np.arange(5) / 60
    source = np.array([0, 1, 1, 2, 3])
    levels = levels_between(pyramid(), world, seconds, source, parts_by_motion(world, seconds, 1.0, 16))
    assert levels is not None
    step, share = levels.at
    assert set(step.tolist()) == {0, 2, 3}
    assert 2 <= np.bincount(step)[0] <= 15
    at = seconds[source[step]] + share / 60
    np.testing.assert_array_equal(levels.grey, render(pyramid(), world, at)[:, :, ::-1])
    few = levels_between(pyramid(), world, seconds, source, parts_by_motion(world, seconds, 3.0, 16))
    assert few is None or len(few.grey) < len(levels.grey)
    still = world_of(RECIPE.replace(world_still_share=1.0, world_patches=0), 1)
    assert levels_between(pyramid(), still, seconds, source, parts_by_motion(still, seconds, 1.0, 16)) is None


# --- events against the exact crossings of the light ------------------------------------------------------------------

GREY = (40.0, 250.0)


@pytest.mark.parametrize(
    ("period_px", "px_per_frame", "threshold"),
    [(32.0, 0.5, 0.3), (32.0, 2.0, 0.1), (32.0, 8.0, 0.1), (32.0, 8.0, 0.3), (100.0, 8.0, 0.3)],
)
def test_signed_events_are_off_by_at_most_two_percent(period_px: float, px_per_frame: float, threshold: float) -> None:
    """Levels between frames are rendered, not guessed; `python -m bench worlds` prints the rest."""
    found = event_errors(waves(GREY, period_px), StreamSpec(substep_px=1.0), px_per_frame, threshold)
    assert found.signed <= 0.02
    assert abs(found.count) <= 0.02


def test_sub_steps_restore_what_a_fast_pattern_loses() -> None:
    """A period a frame: without them, the frames hardly differ."""
    photograph = waves(GREY, 8.0)
    coarse, fine = (event_errors(photograph, StreamSpec(substep_px=px), 8.0, 0.1) for px in (0.0, 0.5))
    assert coarse.count < -0.5
    assert abs(fine.count) < 0.02
    assert fine.signed <= 0.02


FINE = StreamSpec(PRESETS["worlds-fine"])


def test_sixteen_bits_show_what_moves_slowly() -> None:
    """A tenth of a pixel a frame: half a level of 12 bits is much of what changes."""
    coarse, fine = (event_errors(waves(GREY, 32.0), spec, 0.1, 0.1) for spec in (StreamSpec(), FINE))
    assert coarse.signed > 0.03
    assert fine.signed < 0.01


@pytest.mark.parametrize("px_per_frame", [0.5, 2.0, 8.0])
def test_steps_divided_by_threshold_miss_little(px_per_frame: float) -> None:
    for threshold in (0.1, 0.3):
        assert event_errors(waves(GREY, 12.0), FINE, px_per_frame, threshold).signed <= 0.015
    plain = event_errors(photo(), StreamSpec(), px_per_frame, 0.1)
    fine = event_errors(photo(), FINE, px_per_frame, 0.1)
    assert fine.signed <= 0.01 < plain.signed


def test_most_of_the_changing_pixels_change_by_the_share_at_most() -> None:
    """At a still camera no step is divided; the change of a sub-step is that of its own light."""
    seconds = np.arange(9) / 60
    logs = np.log(0.001 + np.linspace(0.0, 1.0, 4096) ** 2.2).astype(np.float32)
    changes, divided = np.stack([logs / 0.2, logs / 0.3]), 0
    for index in range(6):
        world = world_of(RECIPE.replace(world_speed_px=[5.0, 120.0]), index)
        parts = parts_by_change(pyramid(), world, seconds, changes, 0.5, 16)
        divided += int(np.count_nonzero((parts > 1) & (parts < 16)))
        for step in np.flatnonzero(parts < 16):
            at = seconds[step] + np.arange(parts[step] + 1) / (60 * parts[step])
            levels = render(pyramid(), world, at).reshape(len(at), -1)
            brighter, darker = (np.diff(table[levels], axis=0) for table in changes)
            change = np.maximum(brighter, -darker)
            # Light is looked at at the beginning of the step, in one of 16 pixels.
            assert np.quantile(change[change > 0], 0.99) <= 0.5 * 1.35
    assert divided > 6
    still = world_of(RECIPE.replace(world_still_share=1.0, world_patches=0), 1)
    assert (parts_by_change(pyramid(), still, seconds, changes, 0.5, 16) == 1).all()


# --- the same bytes everywhere ----------------------------------------------------------------------------------------

GOLDEN = {
    "pictures": "dfe0d0f09c13f7f0",
    "levels": "bbac211f57deeb64",
    "flow": "866803faaea8e770",
    "masks": "cae9e0dedced0ec4",
    "tracks": "59dafcb16167657d",
}
TILTED = {"resize_scale": (0.6, 0.9), "world_tilt": 0.2, "flip_probability": 1.0}
SEED = 2**64 - 1
CODE = "from tests.server.worlds.test_render import digests; print(*digests().values())"


def digests() -> dict[str, str]:
    """Return digests of the arrays of sixteen worlds."""
    y, x = np.mgrid[:97, :131]
    grey = ((x * x * 3 + y * y * 5 + x * y * 7) // 64 + 60 * ((x // 9 + y // 7) % 3) & 255).astype(np.uint8)
    pyramid, seconds = pyramid_of(grey), np.arange(31) / 30
    found = {name: hashlib.sha256() for name in ("pictures", "levels", "flow", "masks", "tracks")}
    for index in range(16):
        recipe = PRESETS["worlds"].replace(crop_height_px=40, crop_width_px=52, **(TILTED if index % 2 else {}))
        params = draw(recipe, seed=SEED, epoch=3, index=index, picture_height_px=97, picture_width_px=131, video_id="")
        world = draw_world(
            recipe, params, seed=SEED, epoch=3, index=index, picture_px=(97, 131), seconds=(0.0, 1.0)
        )  # fmt: skip
        levels = levels_between(pyramid, world, seconds, np.arange(31), parts_by_motion(world, seconds, 1.0, 16))
        arrays = {
            "pictures": render(pyramid, world, seconds),
            "levels": np.empty(0) if levels is None else levels.grey,
            "flow": np.concatenate(flow_of(world, 0.2, 0.3)),
            "masks": masks_of(world, 0.7),
            "tracks": tracks_of(world, seconds),
        }
        for name, array in arrays.items():
            found[name].update(array.tobytes())
    return {name: digest.hexdigest()[:16] for name, digest in found.items()}


def test_pictures_and_truth_keep_their_bytes() -> None:
    assert digests() == GOLDEN


@pytest.mark.slow
@pytest.mark.timeout(COMPILE_SECONDS + 60)
def test_a_generic_processor_gives_the_same_bytes(tmp_path: Path) -> None:
    assert printed_on_a_generic_processor(CODE, tmp_path) == list(GOLDEN.values())
