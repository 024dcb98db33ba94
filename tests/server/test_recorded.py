"""Arrays of recorded events against evaluation's voxel grids, and against sums in plain Python."""

from __future__ import annotations

import os
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trainer.evaluation import voxelise
from v2v_protocol.recipe import Recipe, preset
from v2v_protocol.sample import SampleParams, array_layout, new_arrays
from v2v_recordings.binning import NEVER, EventsOfCrop
from v2v_recordings.block_file import EventFileWriter
from v2v_recordings.items import NO_EVENTS, ConvertOptions, EventChunk
from v2v_recordings.reading import read_items
from v2v_server.recorded import fill_arrays
from v2v_server.simulation.draw import draw
from v2v_server.store.event_file import EventFile

ALL = ("voxels", "event_counts", "voxels_bilinear", "time_surface")
KINDS = {"voxels": "discrete", "voxels_bilinear": "interpolated"}
SPANS = {"grid": "window", "events": "events"}
SHARED = Path(os.environ.get("V2V_TEST_EVENTS", Path(__file__).parents[3] / "shared/data/events"))
"""Real recordings, which only some hosts have."""


def recipe_of(height: int, width: int, **fields: Any) -> Recipe:
    size = {"crop_height_px": height, "crop_width_px": width}
    return preset("recordings").replace(**{"flip_probability": 0.0, **size, **fields})


def params_of(recipe: Recipe, index: int = 0) -> SampleParams:
    return draw(
        recipe, seed=1, epoch=0, index=index, picture_height_px=recipe.crop_height_px,
        picture_width_px=recipe.crop_width_px, video_id="a",
    )  # fmt: skip


def events_of(t_ns: npt.ArrayLike, *columns: npt.ArrayLike) -> EventChunk:
    x, y, p = map(np.asarray, columns)
    return EventChunk(np.asarray(t_ns, np.int64), x.astype(np.uint16), y.astype(np.uint16), p.astype(bool))


def cropped(
    events: EventChunk, edges: npt.NDArray[np.int64], window: tuple[int, int, int, int], flip: bool
) -> EventsOfCrop:
    top, left, height, width = window
    x, y = events.x.astype(int) - left, events.y.astype(int) - top
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    inside &= (events.t_ns >= edges[0]) & (events.t_ns < edges[-1])
    pixel = y * width + (width - 1 - x if flip else x)
    grids = [events.t_ns[(events.t_ns >= begin) & (events.t_ns < end)].tolist() for begin, end in pairwise(edges)]
    span = np.array([(each[0], each[-1]) if each else (NEVER, NEVER) for each in grids])
    return EventsOfCrop(events.t_ns[inside], pixel[inside], events.p[inside], span)


def made(
    events: EventChunk, edges: npt.NDArray[np.int64], recipe: Recipe, dtype: str = "float32",
    window: tuple[int, int, int, int] | None = None, params: SampleParams | None = None,
) -> tuple[dict[str, Any], dict[str, int]]:  # fmt: skip
    recipe = recipe.replace(voxels_per_clip=len(edges) - 1)
    out, drawn = new_arrays(array_layout(recipe, dtype, ALL)), params or params_of(recipe)
    crop = cropped(events, edges, window or (0, 0, *recipe.crop_px), drawn.flip)
    return out, fill_arrays(crop, edges, recipe, drawn, out)


def evaluated(
    events: EventChunk, edges: npt.NDArray[np.int64], size: tuple[int, int], settings: voxelise.VoxelSettings
) -> npt.NDArray[np.float32]:
    """Return evaluation's grids of the same events, [G, bins, H, W]."""
    grids = []
    for begin, end in pairwise(edges.tolist()):
        part = events.part(*np.searchsorted(events.t_ns, (begin, end)).tolist())
        columns = voxelise.Events(part.t_ns * 1e-9, part.x, part.y, 2 * part.p.astype(np.float32) - 1)
        grids.append(voxelise.voxel_grid(columns, size, settings, (begin * 1e-9, end * 1e-9)))
    return np.stack(grids)


def assert_as_evaluated(events: EventChunk, edges: npt.NDArray[np.int64], size: tuple[int, int], bins: int) -> None:
    for bin_span, span in SPANS.items():
        arrays, _ = made(events, edges, recipe_of(*size, bins=bins, bin_span=bin_span))
        for name, kind in KINDS.items():
            expected = evaluated(events, edges, size, voxelise.VoxelSettings(kind, bins, span))  # type: ignore[arg-type]
            assert np.array_equal(arrays[name], expected), (name, bin_span)
        signed = arrays["event_counts"][:, 1] - arrays["event_counts"][:, 0]
        assert np.array_equal(arrays["voxels"], signed)


@st.composite
def clips(draw: st.DrawFn) -> tuple[EventChunk, npt.NDArray[np.int64]]:
    """Return events on whole microseconds, and the edges of grids, some of them empty."""
    steps = draw(st.lists(st.sampled_from([0, 0, 1, 7, 500, 33_333]), min_size=1, max_size=60))
    times = 1000 * (draw(st.integers(0, 10**7)) + np.cumsum(steps))
    of = [draw(st.lists(st.integers(0, most), min_size=len(steps), max_size=len(steps))) for most in (5, 3, 1)]
    last = int(times[-1]) // 1000 + 5
    edges = draw(st.lists(st.integers(int(times[0]) // 1000 - 5, last), min_size=2, max_size=6))
    return events_of(times, *of), 1000 * np.sort(np.array(edges, np.int64))


@settings(max_examples=80)
@given(clip=clips(), bins=st.integers(1, 7))
def test_grids_are_those_of_evaluation(clip: tuple[EventChunk, npt.NDArray[np.int64]], bins: int) -> None:
    assert_as_evaluated(*clip, (4, 6), bins)


@settings(max_examples=40)
@given(clip=clips(), flip=st.booleans(), top=st.integers(0, 2), left=st.integers(0, 3))
def test_a_crop_and_a_flip_take_a_part_of_the_sensor(
    clip: tuple[EventChunk, npt.NDArray[np.int64]], flip: bool, top: int, left: int
) -> None:
    whole, _ = made(*clip, recipe_of(4, 6))
    part, _ = made(*clip, recipe_of(2, 3, flip_probability=float(flip)), window=(top, left, 2, 3))
    for name in ALL:
        expected = whole[name][..., top : top + 2, left : left + 3]
        assert np.array_equal(part[name], expected[..., ::-1] if flip else expected), name


@settings(max_examples=40)
@given(clip=clips(), bins=st.integers(1, 4))
def test_a_time_surface_is_the_age_of_the_last_event(clip: tuple[EventChunk, npt.NDArray[np.int64]], bins: int) -> None:
    events, edges = clip
    ages = made(events, edges, recipe_of(4, 6, bins=bins))[0]["time_surface"]
    for grid, (begin, end) in enumerate(pairwise(edges.tolist())):
        for number in range(bins):
            seen = np.full((2, 4, 6), np.inf)
            stop = begin + (end - begin) * (number + 1) / bins
            for time, x, y, p in zip(events.t_ns.tolist(), events.x, events.y, events.p, strict=True):
                # A whole microsecond at the edge of a bin belongs to the bin that evaluation puts it into.
                in_bin = bins * ((time - begin) / max(1, end - begin))
                if edges[0] <= time < end and (time < begin or int(in_bin) <= number):
                    seen[int(p), y, x] = max(stop - time, 0.0) * 1e-9
            assert np.allclose(ages[grid, :, number], seen, rtol=1e-6, atol=1e-9)


def test_counts_beyond_the_dtype_are_clipped_and_counted() -> None:
    events = events_of(np.arange(300) * 1000, np.zeros(300), np.zeros(300), np.ones(300))
    arrays, clipped = made(events, np.array([0, 300_000]), recipe_of(2, 2, bins=1), "int8")
    assert arrays["voxels"][0, 0].tolist() == [[127, 0], [0, 0]]
    assert clipped == {"voxels": 1, "event_counts": 1}


def test_added_noise_has_its_sigma_and_hot_pixels_stay() -> None:
    fields = {"added_sigma": (0.1, 0.1), "added_hot_share": (0.01, 0.01), "added_hot_sigma": (5.0, 5.0)}
    recipe = recipe_of(64, 64, **fields)
    edges = np.arange(5) * 1_000_000
    none = NO_EVENTS
    arrays, _ = made(none, edges, recipe)
    noise = arrays["voxels"]
    assert np.array_equal(noise, arrays["voxels_bilinear"])
    assert not arrays["event_counts"].any()
    hot = np.median(noise.reshape(-1, 64 * 64), 0)
    is_hot = abs(hot) > 0.2
    assert 20 <= np.count_nonzero(is_hot) <= 41, "a hundredth of the pixels, of which some are hardly hot"
    others = noise.reshape(-1, 64 * 64)[:, ~is_hot]
    assert abs(others.std() - 0.1) < 0.005
    assert abs(np.corrcoef(others[0], others[1])[0, 1]) < 0.06
    again, _ = made(none, edges, recipe)
    assert np.array_equal(again["voxels"], noise)
    other, _ = made(none, edges, recipe, params=params_of(recipe, 1))
    assert not np.array_equal(other["voxels"], noise)


@pytest.mark.parametrize("name", sorted(path.name for path in SHARED.glob("[di]*")) or ["none"])
def test_real_recordings_give_the_grids_of_evaluation(name: str, tmp_path: Path) -> None:
    if not (SHARED / name).exists():
        pytest.skip("the shared recordings are not on this host")
    with EventFileWriter(tmp_path / "a.v2ve", source=name, fingerprint="") as writer:
        for item in read_items(SHARED / name, None, ConvertOptions()):
            writer.add(item)
    with EventFile(tmp_path / "a.v2ve") as recording:
        times = recording.times_of_every(20_000, 4)
        pictures = recording.pictures_table["t_ns"].astype(np.int64)
        size = recording.head.height_px, recording.head.width_px
        found = recording.between(np.array([-(2**62), 2**62]), (0, 0, *size))
    assert len(found.t_ns) == recording.head.events
    events = events_of(found.t_ns, found.pixel % size[1], found.pixel // size[1], found.brighter)
    for edges in filter(lambda each: len(each) > 1, (times[:4], pictures[:4])):
        whole_us = 1000 * np.rint(edges / 1000).astype(np.int64)
        assert_as_evaluated(events, whole_us, size, 5)
