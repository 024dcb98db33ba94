"""From statistics to decisions: which sequences there are, and which flow each voxel gets."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.pieces import shots
from v2v_protocol.recipe import Recipe
from v2v_protocol.sample import SampleParams
from v2v_protocol.spec import StreamSpec
from v2v_server.corpus.scenes.scene import CHANGE, COLUMNS, CONTRAST, DARK, MOTION, NOISE, TILES, Scene
from v2v_server.simulation.draw import choose_crop
from v2v_server.simulation.view import Window
from v2v_server.worker.scene_choice import LEAN_METHOD, CleanFrames, FlowPlan, crop_weight, plan_flow

RECIPE = Recipe(voxels_per_clip=4, bins=5, crop_height_px=32, crop_width_px=32)
AUTO = StreamSpec(recipe=RECIPE, scene="auto")
SIZE_PX = 128
"""Of the square picture: a crop at a multiple of 32 px is one tile."""


def scene(motion_px: float, change: float, *, dark: float = 0.0, segments: int = 4) -> Scene:
    values = np.zeros((segments, COLUMNS))
    values[:, MOTION], values[:, CHANGE], values[:, CONTRAST], values[:, DARK] = motion_px, change, 20.0, dark
    return Scene.of(shots(16 * segments), values)


def params(**changes: Any) -> SampleParams:
    values: dict[str, Any] = {
        "threshold_pos": 0.5, "threshold_neg": 0.5, "noise_sigma": 0.0, "hot_pixel_count": 0, "hot_pixel_sigma": 0.0,
        "pauses": (), "scale": 1.0, "crop_top_px": 0, "crop_left_px": 0, "flip": False, "contrast": 0.0,
        "noise_key": (0, 0, 0, 0),
    }  # fmt: skip
    return SampleParams(**(values | changes))


def methods(what: Scene, start: int = 0, spec: StreamSpec = AUTO, **changes: Any) -> tuple[str, ...]:
    return plan(what, spec, start, **changes).methods


def plan(what: Scene, spec: StreamSpec = AUTO, start: int = 0, **changes: Any) -> FlowPlan:
    picture = Window(0, 0, SIZE_PX, SIZE_PX)
    return plan_flow(
        what, CleanFrames.of(what, start, spec, spec.recipe.frames_needed), params(**changes), spec, picture
    )


LONG = StreamSpec(recipe=RECIPE.replace(voxels_per_clip=2, frames_per_bin=2), scene="auto")
STRIDED = StreamSpec(recipe=RECIPE.replace(voxels_per_clip=2, frame_stride=2), scene="auto")


@pytest.mark.parametrize(
    ("what", "changes", "expected"),
    [
        # A voxel spans five frames: 0.09 px a frame are less than half a pixel, 0.11 more.
        pytest.param(scene(0.0, 1.1), {}, ("zero",) * 4, id="still"),
        pytest.param(scene(0.09, 3.0), {}, ("dis-ultrafast",) * 4, id="slow"),
        pytest.param(scene(0.11, 3.0), {}, (LEAN_METHOD,) * 4, id="moving"),
        # 1.1 grey levels over four frames are nothing in daylight, and motion in the dark.
        pytest.param(scene(0.09, 1.1, dark=0.95), {}, ("dis-ultrafast",) * 4, id="dark"),
        pytest.param(scene(0.11, 0.1, dark=0.95), {}, ("zero",) * 4, id="still in the dark"),
        # Change and motion grow with the time between two frames, and with the picture.
        pytest.param(scene(0.0, 1.1), {"spec": LONG}, ("dis-ultrafast",) * 2, id="change of a long bin"),
        pytest.param(scene(0.09, 3.0), {"spec": LONG}, (LEAN_METHOD,) * 2, id="motion of a long bin"),
        pytest.param(scene(0.09, 3.0), {"spec": STRIDED}, (LEAN_METHOD,) * 2, id="stride"),
        pytest.param(scene(0.09, 3.0), {"scale": 1.3}, (LEAN_METHOD,) * 4, id="enlarged"),
        # Voxel 0 is one long pause; voxel 1 advances by three frames only: 3 x 0.11 < 0.5.
        pytest.param(
            scene(0.11, 3.0), {"pauses": ((1, 7),)}, ("zero", "dis-ultrafast", LEAN_METHOD, LEAN_METHOD), id="paused"
        ),
    ],
)
def test_the_method_of_each_voxel(what: Scene, changes: dict[str, Any], expected: tuple[str, ...]) -> None:
    assert methods(what, **changes) == expected


def test_only_the_segments_between_the_frames_count() -> None:
    values = scene(0.0, 0.0).segments.copy()
    values[1, MOTION], values[1, CHANGE] = 640, 640  # frames 16 .. 31
    what = Scene(0, 64, shots(64), values)
    # Frames 0 5 10 15 20: the last voxel reaches into the segment that moves, half of what it touches.
    assert methods(what) == ("zero", "zero", "zero", LEAN_METHOD)
    assert methods(what, start=32) == ("zero",) * 4
    assert methods(what, start=12) == (LEAN_METHOD,) * 4


@pytest.mark.parametrize("tile", range(TILES**2))
def test_only_the_tiles_that_the_crop_touches_count(tile: int) -> None:
    still = scene(0.0, 0.0).segments.copy()
    still[:, tile], still[:, TILES**2 + tile] = 640, 640
    what = Scene(0, 64, shots(64), still)
    for other in range(TILES**2):
        row, column = divmod(other, TILES)
        found = methods(what, crop_top_px=32 * row, crop_left_px=32 * column)
        assert found == ((LEAN_METHOD,) * 4 if other == tile else ("zero",) * 4)
        doubled = methods(what, crop_top_px=64 * row, crop_left_px=64 * column, scale=2.0)
        assert (set(doubled) == {"zero"}) == (other != tile)


def test_a_clip_that_moves_in_parts_is_left_to_the_look_at_each_pair() -> None:
    values = scene(0.01, 3.0).segments.copy()
    values[:, 0] = 640
    assert methods(Scene(0, 64, shots(64), values), crop_top_px=16, crop_left_px=16) == ("auto",) * 4


def test_what_was_not_looked_at_is_left_to_the_look_at_each_pair() -> None:
    assert methods(Scene.unknown()) == ("auto",) * 4
    # Frames 0 .. 15 are known: the voxel that ends at frame 20 is not.
    assert methods(scene(0.0, 0.0, segments=1)) == ("zero", "zero", "zero", "auto")
    unknown = scene(0.0, 3.0).segments.copy()
    unknown[:, MOTION] = 65535
    assert methods(Scene(0, 64, shots(64), unknown)) == (LEAN_METHOD,) * 4


def test_lead_voxels_have_no_flow() -> None:
    lead = StreamSpec(recipe=RECIPE.replace(lead_voxels=1), scene="auto")
    values = scene(0.0, 0.0).segments.copy()
    values[0, MOTION], values[0, CHANGE] = 640, 640
    assert methods(Scene(0, 64, shots(64), values), spec=lead, start=11) == ("zero",) * 4


def test_reasons_state_the_figures() -> None:
    values = np.zeros((4, COLUMNS))
    values[:, MOTION], values[:, CHANGE], values[:, DARK], values[:, NOISE] = 2.0, 40.0, 0.95, 1.5
    made = plan(Scene.of(shots(64), values), pauses=((1, 5),))
    assert made.reason == (
        f"moving; flow none 1, {LEAN_METHOD} 3; motion 2.00 px a frame, at most 2.00; change 40.00, flicker 0.00, "
        "noise 1.50 grey levels; dark 95.0% (a dark scene), clipped 0.0%"
    )
    assert "not looked at" in plan(Scene.unknown()).reason


def test_a_method_that_was_asked_for_is_obeyed() -> None:
    asked = StreamSpec(recipe=RECIPE, scene="auto", flow_method="dis-fast-1")
    made = plan(scene(0.0, 0.0), asked)
    assert made.methods == ()
    assert not made.still
    assert made.reason.startswith("still; flow dis-fast-1 as asked; ")


def test_crops_lie_where_the_picture_changes() -> None:
    """Of 8 places drawn, those are likely whose tiles change."""
    values = np.zeros((4, COLUMNS))
    values[:, CHANGE] = 0.0
    values[2, CHANGE.start + 5] = 30.0  # the second tile of the second row: rows and columns 32 .. 63
    what, picture = Scene.of(shots(64), values), Window(0, 0, SIZE_PX, SIZE_PX)
    weigh = crop_weight(what, CleanFrames.of(what, 30, AUTO, 21), 1.0, RECIPE, picture)
    assert weigh(32, 32) == 30 * 64 * 128 * 128
    assert weigh(48, 16) == weigh(32, 32) // 4
    assert weigh(64, 0) == 0
    drawn = params(crop_top_px=96, crop_left_px=96)
    chosen = [
        choose_crop(
            drawn, RECIPE, seed=1, epoch=0, index=index, share=1.0, picture_height_px=SIZE_PX,
            picture_width_px=SIZE_PX, weigh=weigh,
        )
        for index in range(50)
    ]  # fmt: skip
    assert np.mean([weigh(each.crop_top_px, each.crop_left_px) > 0 for each in chosen]) > 0.8


@pytest.mark.parametrize(("share", "weight"), [(0.0, 1), (1.0, 0)])
def test_crops_stay_as_drawn_with_a_share_of_0_and_where_nothing_changes(share: float, weight: int) -> None:
    drawn = params(crop_top_px=7)
    assert drawn == choose_crop(
        drawn, RECIPE, seed=1, epoch=0, index=0, share=share, picture_height_px=SIZE_PX, picture_width_px=SIZE_PX,
        weigh=lambda top, left: weight * top,
    )  # fmt: skip
